# SPDX-License-Identifier: Apache-2.0
"""Studies: tables and figures of the papers, computed anew. Its public names are listed in ``__init__.pyi``."""

from typing import Any

from lathe_rc import public


def __getattr__(name: str) -> Any:
    return public.attribute(__name__, name)
