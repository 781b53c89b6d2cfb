# SPDX-License-Identifier: Apache-2.0
"""The control cell of a CNC lathe for non-circular turning, offline and as ROS 2 nodes."""

__version__ = "0.1.0"
