"""One thread per test process: xdist already keeps every core busy, and results do not depend on the thread count.

The variables have to be set before NumPy or torch is imported, so that happens here, at import.
"""

import os
import secrets
import signal
from collections.abc import Iterator

import pytest

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[variable] = "1"
os.environ["MPLBACKEND"] = "agg"
# Ray reads these at import, too. With a token of our own it leaves none in the home directory.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0"}


@pytest.fixture
def default_signals() -> Iterator[None]:
    """SIGINT and SIGTERM as a program in the foreground has them; a shell starts one in the background without SIGINT.

    Processes that a test starts have them like that, too.
    """
    defaults = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
