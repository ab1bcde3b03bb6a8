"""Lifelong reinforcement learning on mobile robots: the parts that the chapter notebooks share.

Importing the package limits every numerical library to one thread: small networks and small matrices run many times
faster that way on few cores, and sums come out the same on every run.
"""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[_variable] = "1"

__version__ = "0.1.0"
