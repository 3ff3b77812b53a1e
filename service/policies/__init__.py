"""Policies of Alice and Bob: torch networks for learning, a NumPy evaluator of the same parameters for acting."""
