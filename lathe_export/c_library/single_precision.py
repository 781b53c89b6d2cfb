# SPDX-License-Identifier: Apache-2.0
"""Printed C with ``float`` in place of ``double``: types, literals and functions of libm."""

import re

import numpy as np

from lathe_export.c_library.kernel_types import LIBM
from lathe_rc.errors import LatheError

_REPLACED = re.compile(
    rf"/\*.*?\*/|\bdouble\b|\b(?:{'|'.join(sorted(LIBM))})(?=\()|(?<![\w.])\d+(?:\.\d*(?:e[+-]?\d+)?|e[+-]?\d+)",
    re.DOTALL,
)

_LEAST, _MOST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def single(text: str) -> str:
    """Return C with ``float`` in place of ``double``, except in comments.

    A number below the smallest normal float becomes that: it keeps a divisor from being 0.

    Raises:
        LatheError: a number is beyond the largest float.
    """
    return _REPLACED.sub(_replaced, text)


def _replaced(found: re.Match[str]) -> str:
    text = found[0]
    if text.startswith("/*"):
        return text
    if text == "double":
        return "float"
    if text[0].isdigit():
        if float(text) > _MOST:
            raise LatheError(f"{text} is no number of a float; allowed: --real double")
        if 0.0 < float(text) < _LEAST:
            return f"{_LEAST!r}f"
    return f"{text}f"
