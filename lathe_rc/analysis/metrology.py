# SPDX-License-Identifier: Apache-2.0
"""The form error of the part, revolution by revolution."""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FormErrors:
    """Form error of each complete revolution, shape (revolutions,).

    Attributes:
        rms: root mean square over the angle [m].
        largest: largest magnitude [m].
        starts: index of the first sample of each revolution, and of the sample after the last.
    """

    rms: Array
    largest: Array
    starts: npt.NDArray[np.int64]


def form_errors(angle: Array, error: Array) -> FormErrors:
    """Form error by revolution.

    Args:
        angle: true spindle angle [rad], increasing, shape (n,).
        error: form error [m], shape (n,).

    The mean square is taken over the angle, not over time: a place that the spindle passes slowly counts once.
    A revolution that the run ends within is left out, unless less than two samples are missing.
    """
    if angle.size < 2:
        return FormErrors(np.empty(0), np.empty(0), np.zeros(1, dtype=np.int64))
    if angle.size < 2:
        return FormErrors(np.empty(0), np.empty(0), np.zeros(1, dtype=np.int64))
    turns = angle / (2.0 * np.pi)
    step = np.diff(turns, append=2 * turns[-1] - turns[-2])
    whole = int(np.floor(turns[-1] + 2 * step[-1]))
    starts = np.searchsorted(turns, np.arange(whole + 1))
    edges = starts[:-1]
    squares = np.add.reduceat(error * error * step, edges)[:whole] if whole else np.empty(0)
    weight = np.add.reduceat(step, edges)[:whole] if whole else np.empty(0)
    if whole and starts[-1] < angle.size:
        # reduceat runs its last piece to the end of the array; the rest belongs to no complete revolution.
        last = slice(starts[-2], starts[-1])
        squares[-1], weight[-1] = np.sum(error[last] ** 2 * step[last]), np.sum(step[last])
    largest = np.array([np.abs(error[a:b]).max() for a, b in itertools.pairwise(starts)])
    return FormErrors(np.sqrt(squares / weight), largest, starts)
