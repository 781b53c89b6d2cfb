# SPDX-License-Identifier: Apache-2.0
"""The form of the part, revolution by revolution, from pieces of a run; memory does not grow with its length."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.analysis.metrology import undulations
from lathe_rc.errors import LatheError

Array = npt.NDArray[np.float64]

ANGLES = 360  #: parts of a revolution
HIGHEST = 50  #: of the harmonics [UPR]
_FEWEST = 4.0  # samples a revolution; no spindle turns faster between two of them


@dataclass(frozen=True)
class Revolution:
    """One complete revolution.

    Attributes:
        number: from 1.
        end: index of the first sample after it.
        error: form error, mean of the samples in each of `ANGLES` parts [m], shape (ANGLES,).
        radius: what the part has of the form, as deviation of its radius: desired less error [m], shape (ANGLES,).
        height: mean position along the part [m].
        rms: of the form error, over the angle [m].
        largest: magnitude of the form error [m].
    """

    number: int
    end: int
    error: Array
    radius: Array
    height: float
    rms: float
    largest: float

    def harmonics(self) -> Array:
        """Amplitudes of the form error by undulations per revolution [m], shape (HIGHEST + 1,)."""
        amplitude = undulations(self.error[None], HIGHEST).amplitude[0]
        # A mean over a part of the circle weakens an undulation by the sine cardinal of what it covers of it.
        return np.asarray(amplitude / np.sinc(np.arange(HIGHEST + 1) / ANGLES))


class Revolutions:
    """Collects samples and gives the revolutions that are complete.

    RMS and largest error are those of `lathe_rc.analysis.form_errors`.
    """

    def __init__(self) -> None:
        self._started = False
        self._held: dict[str, Array] = {}  # the last sample: the angle that it stands for ends with the next one
        self._next = 0  # index of the sample after it
        self._step = 0.0  # from the sample before it [revolution]
        self._clear(0)

    def _clear(self, revolution: int) -> None:
        self._revolution = revolution  # the one under way, from 0
        self._entire = False  # whether its first samples were there
        self._weight = np.zeros(ANGLES)
        self._sums = {name: np.zeros(ANGLES) for name in ("error", "reference")}
        self._height = self._square = self._angle = self._largest = 0.0
        self._count = 0

    def add(self, first: int, angle: Array, error: Array, reference: Array, height: Array) -> Iterator[Revolution]:
        """Take consecutive samples; where some are missing before them, the revolution under way is dropped.

        Args:
            first: index of the first sample.
            angle: true spindle angle [rad], not decreasing, shape (n,).
            error: form error [m], shape (n,).
            reference: desired displacement [m], shape (n,).
            height: position along the part [m], shape (n,).

        Raises:
            LatheError: the angle goes back, or faster than any spindle.
        """
        turns = angle / (2.0 * np.pi)
        new = {"turns": turns, "error": error, "reference": reference, "height": height}
        if not self._held or first != self._next:
            self._started = False
            self._held = {name: values[:0] for name, values in new.items()}
        held = {name: np.concatenate([self._held[name], values]) for name, values in new.items()}
        self._held = {name: values[-1:] for name, values in held.items()}
        start, self._next = first - held["turns"].size + turns.size, first + turns.size
        yield from self._take(start, held, np.diff(held["turns"]))

    def finish(self) -> Iterator[Revolution]:
        """The last revolution, if less than two samples of it are missing."""
        if self._step > 0.0:
            yield from self._take(self._next - 1, self._held, np.array([self._step]))
            if self._held["turns"][0] + 2.0 * self._step >= self._revolution + 1:
                yield from self._complete(self._next)

    def _take(self, start: int, samples: dict[str, Array], step: Array) -> Iterator[Revolution]:
        """Take samples; ``step`` is how far each goes [revolution], one fewer than samples except at the end."""
        turns = samples["turns"][: step.size]
        if not step.size:
            return
        possible = (step >= 0.0) & (step <= 1.0 / _FEWEST)
        if not possible.all():
            bad = int(np.argmin(possible))
            raise LatheError(
                f"the true spindle angle goes by {step[bad]:.4g} revolutions after sample {start + bad}; allowed: from "
                f"0 to {1.0 / _FEWEST:g}"
            )
        self._step = float(step[-1])
        whole = np.floor(turns)
        if not self._started:
            self._clear(int(whole[0]))
            self._entire = turns[0] - whole[0] <= 1.5 * step[0]
            self._started = True
        edges = np.flatnonzero(np.diff(whole)) + 1
        for a, b in zip([0, *edges], [*edges, turns.size], strict=True):
            if whole[a] > self._revolution:
                yield from self._complete(start + int(a))
                self._clear(int(whole[a]))
                self._entire = True
            self._part(turns[a:b] - whole[a], {name: values[a:b] for name, values in samples.items()}, step[a:b])

    def _part(self, turn: Array, samples: dict[str, Array], step: Array) -> None:
        """Add samples of one revolution to its sums."""
        place = np.minimum((turn * ANGLES).astype(np.intp), ANGLES - 1)
        self._weight += np.bincount(place, minlength=ANGLES)
        for name in self._sums:
            self._sums[name] += np.bincount(place, samples[name], ANGLES)
        error = samples["error"]
        self._square += float(np.dot(error * error, step))
        self._angle += float(step.sum())
        self._largest = max(self._largest, float(np.abs(error).max()))
        self._height += float(samples["height"].sum())
        self._count += turn.size

    def _complete(self, end: int) -> Iterator[Revolution]:
        if not self._entire or self._angle == 0.0:
            return
        there = self._weight > 0
        place = np.arange(ANGLES)
        error, reference = (
            np.interp(place, place[there], total[there] / self._weight[there], period=ANGLES)
            for total in self._sums.values()
        )
        yield Revolution(
            self._revolution + 1,
            end,
            error,
            reference - error,
            self._height / self._count,
            float(np.sqrt(self._square / self._angle)),
            self._largest,
        )
