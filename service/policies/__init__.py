"""Policies of Alice and Bob: torch networks for learning, the same in NumPy for acting."""
