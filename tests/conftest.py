"""One thread per test process: xdist already keeps every core busy, and results do not depend on the thread count.

The variables have to be set before NumPy or torch is imported, so that happens here, at import.
"""

import os
import secrets

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[variable] = "1"
os.environ["MPLBACKEND"] = "agg"
# Ray reads these at import, too. With a token of our own it leaves none in the home directory.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0"}
