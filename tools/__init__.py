"""Tools beside the benchmarks: faults for a real run, the deployment, the docs, and shipping primitives.

What a user can correct is a ``TandemError``, as in the benchmarks; their programs print its one line.
"""

import benchmarks  # noqa: F401 - sets the number of threads before NumPy is imported
