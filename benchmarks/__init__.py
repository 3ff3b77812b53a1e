"""Measurements of throughput and learning, and ``benchmarks.report``, which makes the pages of what they record."""

import os

# Before NumPy is imported, as the command line does it: one thread for each library.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
