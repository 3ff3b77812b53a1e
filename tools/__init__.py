"""Tools beside the benchmarks: faults, load and long runs against a real run, pictures for the documents, shipping."""

import benchmarks  # noqa: F401 - sets the number of threads before NumPy is imported
