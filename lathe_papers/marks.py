# SPDX-License-Identifier: Apache-2.0
"""Marks of the figures that compare several things: each has a marker beside its colour.

The colours are those of Okabe and Ito, which most colour-blind people can distinguish; yellow is replaced by brown.
"""

from typing import Any

COLOURS = (
    "#0072b2", "#d55e00", "#000000", "#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#6e2c00", "#9467bd", "#7f7f7f",
)  # fmt: skip
MARKERS = "osD^v<>Px*"


def point(number: int) -> dict[str, Any]:
    """Return colour and marker of the points of one of several things, counted from 0."""
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def curve(number: int) -> dict[str, Any]:
    """Return colour and marker of a curve; the markers are spread over its length, those of neighbours apart."""
    return {**point(number), "ms": 4, "markevery": (0.02 + 0.03 * (number % 4), 0.12)}
