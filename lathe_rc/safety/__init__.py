# SPDX-License-Identifier: Apache-2.0
"""Faults and reactions: `faults` defines the kinds of faults, `injection` applies them at ports.

`state_machine`: the states of a supervised cell.
"""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
