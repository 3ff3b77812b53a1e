"""Runs: the two runners, and the signals, bookkeeping and reporting around them."""
