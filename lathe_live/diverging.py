# SPDX-License-Identifier: Apache-2.0
"""Colours of signed errors in bodies and in the Rerun view, which are those of the figures in pages (page.css)."""

import re
from functools import cache

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.drawing.pages import own_file


@cache
def _stops() -> Array:
    """Return the RGB colours at uniformly spaced places from -1 to 1, shape (stops, 3)."""
    told = re.search(r"--below-zero-above: ([^;]+);", own_file("page.css"))
    assert told is not None, "page.css has the colours"
    return np.array([[int(code[k : k + 2], 16) for k in (1, 3, 5)] for code in told[1].split()], dtype=np.float64)


def colours(share: Array) -> npt.NDArray[np.uint8]:
    """Return RGBA colours of -1 to 1, those of all figures (page.css, light), shape (n, 4)."""
    stops = _stops()
    place = (np.clip(share, -1.0, 1.0) + 1.0) / 2.0 * (len(stops) - 1)
    found = np.stack([np.interp(place, np.arange(len(stops)), stops[:, k]) for k in range(3)], axis=1)
    return np.concatenate([found.round(), np.full((share.size, 1), 255.0)], axis=1).astype(np.uint8)
