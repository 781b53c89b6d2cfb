# SPDX-License-Identifier: Apache-2.0
"""Form of the part, tool and gauge."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
