# SPDX-License-Identifier: Apache-2.0
"""Stages of the cell: physics and control laws with their parameters and ports, a folder a family.

The framework finds them by name (`lathe_rc.catalogue`) and imports none of them.
"""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
