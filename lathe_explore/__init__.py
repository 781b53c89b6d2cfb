# SPDX-License-Identifier: Apache-2.0
"""Many variations of a cell: sweeps into a table, and the search for parameters that meet given goals.

The public names are listed in ``__init__.pyi``.
"""

from typing import Any

from lathe_rc import public


def __getattr__(name: str) -> Any:
    return public.attribute(__name__, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__getattr__("__all__")])
