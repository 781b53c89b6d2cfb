# SPDX-License-Identifier: Apache-2.0
"""Measuring side by side: A B A B ..., so that a machine whose speed wanders slows all sides alike."""

import contextlib
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

Spread = dict[str, float]


def spread(figures: Sequence[float]) -> Spread:
    """Median, lowest and highest of some figures, and how many they are."""
    return {
        "median": statistics.median(figures),
        "low": min(figures),
        "high": max(figures),
        "runs": len(figures),
    }


def seconds(action: Callable[[], object]) -> float:
    """Wall time of an action [s]."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """This thread, and those that it starts meanwhile, on one core of those that it may use."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def alternate(sides: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Ask each side for its figure in turn, ``rounds`` times; the figures of one round belong together."""
    found: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            found[name].append(side())
    return found


def ratio(over: Sequence[float], under: Sequence[float]) -> Spread:
    """Spread of the quotients of figures that were measured in the same rounds."""
    return spread([a / b for a, b in zip(over, under, strict=True)])
