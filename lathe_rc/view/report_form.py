# SPDX-License-Identifier: Apache-2.0
"""Form of the part from a stream of samples; each revolution is measured as soon as it is complete."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from lathe_rc.analysis.metrology import POINTS, Lay, Measurement, evenly, lay, measure
from lathe_rc.analysis.tolerance import LAST, Growth, Verdict
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.soundness import Soundness
from lathe_rc.errors import InputError
from lathe_rc.judge import part
from lathe_rc.messages import Samples, Signals
from lathe_rc.signals.form_errors import that_count
from lathe_rc.view.report_series import Envelope, MeanRows

ACROSS = 512  #: number of angles in the map
CUTOFF = 50.0  #: cutoff of the filters for roundness and roughness [UPR], as in `lathe measure`
_MARGIN = 64  # samples on each side, with which a spline agrees with that of the whole run to a bit or two
_AT_ONCE = 16  # revolutions measured at a time
_ALONG = 8  # revolutions in the surface along the part
_LONGEST = 2**22  # largest number of samples in one revolution
_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Revolution:
    """Form of one revolution in the report.

    Attributes:
        numbers: key figures of the revolution (see `lathe_rc.judge.part.numbers`).
        profile: radius deviation at uniformly spaced angles [m], shape (points,).
        amplitude: amplitudes of the undulations [m], starting at 0 UPR.
    """

    numbers: Mapping[str, Any]
    profile: Samples
    amplitude: Samples


class FormByRevolution:
    """Form error of one tool by revolution; a sink (see `lathe_rc.cell.engine.Sink`).

    Args:
        encoder: topic with the angle.
        tool: topic with the form error.
        tolerances: those of the form.
        nose_radius: nose radius of the tool in the plane of the feed [m]; 0: no surface along the part.
        types: message types of the bag by topic, for the signals that the form error is made of.

    Attributes:
        tool, tolerances: see the arguments.
        first, last, best: first, last and best (by RMS) revolution; None until one is measured.
        rms, largest: envelopes over the revolutions [m].
        map: radius deviation [m], by revolution and angle.
        newest: radius deviation of the last revolutions at uniformly spaced angles [m], shape (points,) each.
        surface: surface along the part, or the reason why it is missing; None without a nose radius.
        refused: reason why the form, or the rest of it, is not measured; empty if it is.
    """

    def __init__(
        self,
        encoder: str,
        tool: str,
        tolerances: part.Tolerances = part.Tolerances(),  # noqa: B008 - it never changes
        nose_radius: float = 0.0,
        types: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._part = RunningForm(encoder, tool, Soundness.of_form(types), tolerances.zones)
        self._encoder, self.tool, self.tolerances, self._nose_radius = encoder, tool, tolerances, nose_radius
        # Angle, form error and height (0 without a nose radius), starting at a margin before the next revolution.
        self._held = np.empty((3, 0))
        self._along = deque[tuple[Samples, Samples]](maxlen=_ALONG)  # profiles and heights
        self.surface: Lay | str | None = None
        self._done = 0  # revolutions measured
        self.first: Revolution | None = None
        self.last: Revolution | None = None
        self.best: Revolution | None = None
        self.rms, self.largest = Envelope(), Envelope()
        self.map = MeanRows(ACROSS)
        self.newest = deque[Samples](maxlen=LAST)
        self.refused = ""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add consecutive samples; revolutions are measured as soon as they are complete."""
        if self.refused:
            return
        soundness = self._part.soundness
        sound = soundness.sound(first, samples, sparse)
        if not sound:
            self._refuse(soundness.why)
            return
        angle = dense[self._encoder]["angle_true"][:sound]
        tool = {name: array[:sound] for name, array in dense[self.tool].items()}
        try:
            self._part.add(first, angle, tool)
        except InputError as error:
            self._refuse(str(error))
            return
        if first and not self._held.size and not self._done:  # a snapshot begins in the middle of a revolution
            self._done = self._part.before
        height = tool["height"] if self._nose_radius else np.zeros(sound)
        new = np.stack([angle, tool["error"], height])[:, that_count(angle, tool["error"])]
        self._held = np.concatenate([self._held, new], axis=1)
        self._measure(0 if sound < samples else _MARGIN)
        if sound < samples and not self.refused:
            self._refuse(soundness.why)

    @property
    def verdict(self) -> Verdict | None:
        """Return whether the form is in tolerance; None without a tolerance or a measurement up to the end."""
        return None if self.refused else self.tolerances.verdict(self._part)

    @property
    def growth(self) -> Growth | None:
        """Return the growth of the form error over the measured revolutions; None if it does not grow."""
        return part.error_growth(self._part)

    def finish(self) -> None:
        """Measure the remaining revolutions."""
        if not self.refused:
            self._measure(0)
        if self._nose_radius and self._along:
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    profiles, heights = (np.array(rows) for rows in zip(*self._along, strict=True))
                    self.surface = lay(profiles, heights, self._nose_radius)
            except InputError as error:
                self.surface = str(error)

    def _measure(self, margin: int) -> None:
        """Measure complete revolutions that end ``margin`` samples or more before the newest or a non-finite sample."""
        finite = np.isfinite(self._held).all(axis=0)
        broken = not finite.all()
        if broken:
            # No samples can follow, so the revolutions before are measured up to their end.
            margin, self._held = 0, self._held[:, : np.argmin(finite)]
        try:
            self._check()
            with np.errstate(over="ignore", invalid="ignore"):  # for absurd samples, which the numbers show
                while self._measure_some(margin):
                    pass
        except InputError as error:
            self._refuse(str(error))
        if broken and not self.refused:
            self._refuse("samples that are not finite")

    def _refuse(self, reason: str) -> None:
        self.refused = f"{reason} (after revolution {self._done})"
        self._held = np.empty((3, 0))

    def _check(self) -> None:
        """Reject samples that would take too much memory or do not give a form.

        Raises:
            InputError: the samples are rejected, with the reason.
        """
        angle = self._held[0]
        step = np.diff(angle)
        if step.size and not (step.min() >= 0.0 and step.max() < _TURN / 3):
            raise InputError("the angle falls, or rises by more than a third of a turn in a sample")
        if self._done == 0 and angle.size and not 0.0 <= angle[0] < _TURN:
            raise InputError(f"the angle begins at {angle[0]:g} rad; allowed: in the first turn")
        if angle.size > _LONGEST:
            raise InputError(f"a revolution longer than {_LONGEST} samples")

    def _measure_some(self, margin: int) -> bool:
        """Measure some revolutions; return True if any were complete."""
        _, error, height = self._held
        angle = self._held[0] - self._done * _TURN
        edges = np.searchsorted(angle, _TURN * np.arange(_AT_ONCE + 1))
        whole = int(np.count_nonzero(edges[1:] + margin < angle.size)) if margin else _AT_ONCE
        if not whole:
            return False
        # The spline through a revolution depends on the samples beyond its end. With these, the numbers agree with
        # those of the whole run, however the run is divided into chunks.
        stop = int(edges[whole]) + _MARGIN
        found = measure(angle[:stop], error[:stop], roundness_cutoff=CUTOFF, roughness_cutoff=CUTOFF)
        whole = min(whole, found.form.rms.size)
        if not whole:
            return False
        self._record(found, whole)
        if self._nose_radius:
            heights = evenly(angle[:stop], height[:stop])
            self._along.extend(zip(found.profile[:whole], heights[:whole], strict=True))
        self._done += whole
        self._held = self._held[:, max(0, int(np.searchsorted(angle, whole * _TURN)) - _MARGIN) :]
        return True

    def _record(self, found: Measurement, whole: int) -> None:
        self.map.add(found.profile[:whole].reshape(whole, ACROSS, POINTS // ACROSS).mean(axis=-1))
        self.newest.extend(found.profile[max(0, whole - LAST) : whole].copy())
        rms = found.form.rms[:whole]
        self.rms.add(rms)
        self.largest.add(found.form.largest[:whole])
        if self.first is None:
            self.first = self._revolution(found, 0)
        best = int(np.argmin(rms))
        if self.best is None or rms[best] * 1e6 < self.best.numbers["rms"]:  # numbers are in µm
            self.best = self._revolution(found, best)
        self.last = self._revolution(found, whole - 1)

    def _revolution(self, found: Measurement, k: int) -> Revolution:
        # Copies: a view would keep all revolutions measured with this one in memory.
        numbers = {**part.numbers(found, k), "revolution": self._done + k + 1}
        return Revolution(numbers, found.profile[k].copy(), found.undulations.amplitude[k].copy())
