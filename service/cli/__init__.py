"""The command line: one module per group of commands."""

import os

# Worlds are stepped by MuJoCo's threads; those of NumPy and torch only get in their way, and change the last bits of
# what is learned. Both read these variables when they are first imported: the modules of this package do that.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
