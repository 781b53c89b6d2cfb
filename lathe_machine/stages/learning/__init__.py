# SPDX-License-Identifier: Apache-2.0
"""Laws of the tool: `law` and `learner` are common to all; each controller is a file."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
