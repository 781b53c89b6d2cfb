# SPDX-License-Identifier: Apache-2.0
"""Form of the part by revolution, computed from chunks of a run; memory use does not grow with the run."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lathe_rc.analysis.metrology import undulations
from lathe_rc.arrays import Array
from lathe_rc.errors import LatheError

ANGLES = 360  #: number of sectors in a revolution
HIGHEST = 50  #: highest harmonic [UPR]
_FEWEST = 4.0  # smallest number of samples per revolution, at the highest plausible speed
_LONGEST = 2**22  # largest number of samples in one revolution


@dataclass(frozen=True)
class DrawnRevolution:
    """Form of the part in one complete revolution.

    Attributes:
        number: number of the revolution, starting at 1.
        end: index of the first sample after the revolution.
        error: form error, mean of the samples in each of `ANGLES` sectors [m], shape (ANGLES,).
        radius: radius deviation of the part, desired form minus form error [m], shape (ANGLES,).
        height: mean position along the part [m].
        rms: RMS of the form error over the angle [m].
        largest: largest magnitude of the form error [m].
    """

    number: int
    end: int
    error: Array
    radius: Array
    height: float
    rms: float
    largest: float

    def harmonics(self) -> Array:
        """Return the amplitudes of the form error by undulations per revolution [m], shape (HIGHEST + 1,)."""
        amplitude = undulations(self.error[None], HIGHEST).amplitude[0]
        # A mean over a sector attenuates an undulation by the sinc of the covered fraction of its period.
        return np.asarray(amplitude / np.sinc(np.arange(HIGHEST + 1) / ANGLES))


def steps_of(turns: Array, first: int) -> Array:
    """Return the steps [revolution] from sample to sample of consecutive samples, shape (n - 1,).

    Args:
        turns: true spindle angle [revolution], shape (n,).
        first: index of the first sample.

    Raises:
        LatheError: the angle decreases, or increases faster than any spindle.
    """
    step = np.diff(turns)
    possible = (step >= 0.0) & (step <= 1.0 / _FEWEST)
    if not possible.all():
        bad = int(np.argmin(possible))
        raise LatheError(
            f"the true spindle angle goes by {step[bad]:.4g} revolutions after sample {first + bad}; allowed: from "
            f"0 to {1.0 / _FEWEST:g}"
        )
    return np.asarray(step)


def _measured(samples: Array, step: Array, end: int) -> Iterator[DrawnRevolution]:
    """Yield the revolution of samples that each cover an angle step [revolution]; none if the spindle stood still."""
    turns, error, reference, height = samples
    if not step.any():
        return
    number = int(turns[0])
    place = np.minimum(((turns - number) * ANGLES).astype(np.intp), ANGLES - 1)
    weight = np.bincount(place, minlength=ANGLES)
    there, angles = weight > 0, np.arange(ANGLES)
    mean_error, mean_reference = (
        np.interp(angles, angles[there], np.bincount(place, values, ANGLES)[there] / weight[there], period=ANGLES)
        for values in (error, reference)
    )
    rms = float(np.sqrt(np.dot(error * error, step) / step.sum()))
    radius = mean_reference - mean_error
    yield DrawnRevolution(number + 1, end, mean_error, radius, float(height.mean()), rms, float(np.abs(error).max()))


class Revolutions:
    """Accumulator of samples that yields complete revolutions.

    RMS and largest error agree with `lathe_rc.signals.form_errors`.
    """

    def __init__(self) -> None:
        # Angle [revolution], error, reference and height of the current revolution, shape (4, n); a sample covers the
        # angle up to the next one.
        self._held = np.empty((4, 0))
        self._next = 0  # index of the next sample
        self._step = 0.0  # angle step to the last sample [revolution]
        self._entire: bool | None = None  # the revolution's first samples are present; None: not known yet

    def add(self, first: int, angle: Array, error: Array, reference: Array, height: Array) -> Iterator[DrawnRevolution]:
        """Add consecutive samples and return complete revolutions; a gap before them drops the current revolution.

        Args:
            first: index of the first sample.
            angle: true spindle angle [rad], not decreasing, shape (n,).
            error: form error [m], shape (n,).
            reference: desired displacement [m], shape (n,).
            height: position along the part [m], shape (n,).

        Raises:
            LatheError: the angle decreases, or increases faster than any spindle.
        """
        if first != self._next:
            self._held, self._entire = np.empty((4, 0)), None
        start, self._next = first - self._held.shape[1], first + angle.size
        held = np.concatenate([self._held, np.stack([angle / (2.0 * np.pi), error, reference, height])], axis=1)
        turns, step = held[0], steps_of(held[0], start)
        self._held = held
        if not step.size:
            return
        self._step = float(step[-1])
        if self._entire is None:
            # The first sample is less than one step after the beginning; another half step allows for varying speed.
            self._entire = bool(turns[0] % 1.0 <= 1.5 * step[0])
        begins = [0] * self._entire + (np.flatnonzero(np.diff(np.floor(turns))) + 1).tolist()
        for a, b in pairwise(begins):
            yield from _measured(held[:, a:b], step[a:b], start + b)
        self._entire = bool(begins) and turns.size - begins[-1] <= _LONGEST
        self._held = held[:, begins[-1] if self._entire else -1 :]  # at least one sample, for the step to the next one

    def finish(self) -> Iterator[DrawnRevolution]:
        """Return the last revolution, if fewer than two of its samples are missing."""
        turns = self._held[0]
        if self._entire and self._step > 0.0 and turns[-1] + 2.0 * self._step >= np.floor(turns[-1]) + 1.0:
            yield from _measured(self._held, np.append(np.diff(turns), self._step), self._next)
