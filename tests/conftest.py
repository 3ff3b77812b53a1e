"""One thread per test process: xdist already keeps every core busy, and results do not depend on the thread count.

The variables have to be set before NumPy or torch is imported, so that happens here, at import.
"""

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[variable] = "1"
os.environ["MPLBACKEND"] = "agg"
