# SPDX-License-Identifier: Apache-2.0
"""The control cell of a CNC lathe for non-circular turning, offline and as ROS 2 nodes."""

import os

__version__ = "0.1.0"

# The matrices here are small. Threads of BLAS that wait for the next one keep the cores busy that other nodes need.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
