"""Bounds of the log-std before the tanh, as torch and NumPy share them."""

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Of an actor (Haarnoja et al. 2018)."""
MCP_LOG_STD_MIN = -5.0
"""Of a primitive: with less, one that is sure decides alone and the others get no gradient."""
