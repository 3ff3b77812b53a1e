"""Tools beside the benchmarks: faults and load for a real run, and shipping primitives."""

import benchmarks  # noqa: F401 - sets the number of threads before NumPy is imported
