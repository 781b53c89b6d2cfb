# SPDX-License-Identifier: Apache-2.0
"""Metrology of the turned part: form errors, roughness and tolerance from a recording of a run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import messages
from lathe_rc.analysis import profile_csv
from lathe_rc.analysis.metrology import Lay, Measurement, evenly, lay, measure
from lathe_rc.analysis.tolerance import Growth, Verdict, growth, judge_zones
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.judged import Judged
from lathe_rc.cell.parameters import form_doubt, judged
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError
from lathe_rc.messages import Signals
from lathe_rc.signals.form_errors import that_count, turns_before
from lathe_rc.signals.zones import Zone

_CUTOFF = 50.0  # cutoff of the roundness and roughness filters [undulations per revolution]
_TOGETHER = 16  # number of revolutions evaluated together


def measured(recording: Recording, *, cutoff: float = _CUTOFF) -> Measurement:
    """Measure the turned part of a run (see `lathe_rc.analysis.metrology.measure`).

    Args:
        recording: recording of the run, with an encoder and a tool.
        cutoff: cutoff of the roundness and roughness filters [undulations per revolution].

    Raises:
        InputError: the recording has no encoder, no tool, or no complete revolution.
    """
    if not {messages.TOOL, messages.ENCODER} <= set(recording.types.values()):
        raise InputError("nothing to measure: the recording has no encoder and tool; record both")
    sound, reason = recording.sound_form
    angle, error = (
        recording.of_type(kind)[field][:sound]
        for kind, field in ((messages.ENCODER, "angle_true"), (messages.TOOL, "error"))
    )
    angle = angle - 2.0 * np.pi * recording.turns_before
    found = measure(angle, error, roundness_cutoff=cutoff, roughness_cutoff=cutoff)
    if not found.form.rms.size:
        why = f": {reason}" if reason else "; let it run longer"
        raise InputError(f"nothing to measure: the recording has no complete revolution{why}")
    return found


def tolerances(declared: Mapping[str, Judged]) -> dict[str, float]:
    """Return the tolerance [m] of each tool that declares one, by relative topic."""
    forms = [each for each in declared.values() if each.quantity == "form"]
    return {each.topic: each.tolerance for each in forms if each.tolerance}


def zones(declared: Mapping[str, Judged]) -> dict[str, tuple[Zone, ...]]:
    """Return the zones with tolerances of their own of each tool that declares some, by relative topic."""
    return {each.topic: each.zones for each in declared.values() if each.zones}


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of the form of a part.

    Attributes:
        tolerance: allowed form error to each side [m]; 0: the tool has no tolerance.
        zones: parts of the surface with tolerances of their own.
        doubt: how far the desired form may be off between the points of its table [m].
    """

    tolerance: float = 0.0
    zones: tuple[Zone, ...] = ()
    doubt: float = 0.0

    @classmethod
    def of(cls, declared: Mapping[str, Judged], topic: str, doubt: float = 0.0) -> "Tolerances":
        """Return what nodes declare for the tool of a fully qualified topic."""
        own = [each for each in declared.values() if topic.endswith(f"/{each.topic}")]
        allowed = next((each.tolerance for each in own if each.quantity == "form" and each.tolerance), 0.0)
        return cls(allowed, next((each.zones for each in own if each.zones), ()), doubt)

    def verdict(self, form: RunningForm, unjudged: str = "", revolutions: int | None = None) -> Verdict | None:
        """Judge a form, measured by the same zones, as if the run ended after the samples so far.

        Args:
            form: the form.
            unjudged: reason why the end of the run cannot be judged; empty if it can.
            revolutions: number of revolutions that are judged, the first ones; None: all.

        Returns:
            None without a tolerance.
        """
        if not self.tolerance:
            return None
        largest, *by_zone = (each[:revolutions] for each in (form.largest, *form.by_zone))
        return judge_zones(
            largest, by_zone, self.tolerance, self.zones, form.before, unjudged=unjudged, doubt=self.doubt
        )


def strictest(declared: Mapping[str, Judged]) -> float:
    """Return the smallest tolerance of the forms and their zones [m]; 0 if there is none."""
    allowed = [limit for each in declared.values() if each.quantity == "form" for limit in each.tolerances if limit]
    return min(allowed, default=0.0)


def nose_radius(declared: Mapping[str, Judged]) -> float:
    """Return the nose radius of the tool [m] that nodes declare; 0 if none does."""
    return next((each.nose_radius for each in declared.values() if each.nose_radius), 0.0)


def verdict(scenario: Scenario, recording: Recording) -> Verdict | None:
    """Judge whether the part turned in a run is within tolerance; None if the tool has no tolerance."""
    topic = next((topic for topic in recording.dense if recording.types[topic] == messages.TOOL), "")
    tolerances = Tolerances.of(judged(scenario.nodes), topic, form_doubt(scenario.nodes))
    form = recording.form_by(tolerances.zones) if tolerances.zones else recording.form
    return tolerances.verdict(form, recording.sound_form[1])


def error_growth(form: RunningForm) -> Growth | None:
    """Return the growth of a form error (see `lathe_rc.analysis.tolerance.growth`)."""
    return growth(form.largest, form.before)


def surface(recording: Recording, found: Measurement, nose_radius: float) -> Lay:
    """Measure the surface along the turned part (see `lathe_rc.analysis.metrology.lay`).

    Args:
        recording: recording of the run.
        found: measurement of the same recording by `measured`.
        nose_radius: nose radius of the tool in the plane of the feed [m].
    """
    sound, _ = recording.sound_form
    angle, height = recording.of_type(messages.ENCODER)["angle_true"], recording.of_type(messages.TOOL)["height"]
    height = evenly(angle[:sound] - 2.0 * np.pi * recording.turns_before, height[:sound])
    return lay(found.profile, height, nose_radius)


def along(found: Lay) -> dict[str, Any]:
    """Return the surface figures along the part; lengths in µm, the feed in µm per revolution."""
    rt, ra = found.rt * 1e6, found.ra * 1e6
    return {
        "revolutions": found.revolutions,
        "feed": found.feed * 1e6,
        "ra": float(ra.mean()),
        "rt": float(rt.mean()),
        "rt_worst": float(rt.max()),
        "rt_errorless": found.errorless * 1e6,
    }


def along_in_words(found: Lay) -> str:
    """Format the surface figures along the part as one line of text."""
    told = along(found)
    return (
        f"along the part, last {told['revolutions']} revolutions at {told['feed']:.4g} µm/rev: Ra {told['ra']:.3g} µm, "
        f"Rt {told['rt']:.3g} µm (worst {told['rt_worst']:.3g}); without any error Rt {told['rt_errorless']:.3g} µm"
    )


def numbers(found: Measurement, revolution: int) -> dict[str, Any]:
    """Return the figures for one revolution, counted from 0; lengths in µm."""
    around, waves = found.roundness, found.undulations.amplitude[revolution]
    largest = int(np.argmax(waves[2:])) + 2  # harmonic 0 is the size of the part, 1 its eccentricity

    def um(values: np.ndarray) -> float:
        return float(values[revolution]) * 1e6

    return {
        "revolution": revolution % found.form.rms.size + 1,
        "rms": um(found.form.rms),
        "max": um(found.form.largest),
        "peak_to_valley": um(found.form.peak_to_valley),
        "ront": um(around.peak_to_valley),
        "ronq": um(around.rms),
        "centre": [um(around.x), um(around.y)],
        "largest_upr": {"upr": largest, "amplitude": float(waves[largest]) * 1e6},
        "ra": um(found.roughness.ra),
    }


class FirstAndLast:
    """Sink of the engine that collects the first and the last revolutions of a run, chunk by chunk.

    Args:
        types: message type by topic, as the chunks name them; includes an encoder and a tool.

    Attributes:
        soundness: end of the samples on which the form error may rest.
    """

    def __init__(self, types: Mapping[str, str]) -> None:
        form = RunningForm.of(types)
        self._encoder, self._tool, self.soundness = form.encoder, form.tool, form.soundness
        self._head = self._tail = np.empty((2, 0))  # angle and error
        self._start = 0.0  # angle at the start of the first revolution [rad]
        self._before = 0  # revolutions before the tail

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add a chunk of the run (implements `lathe_rc.cell.engine.Sink`)."""
        sound = self.soundness.sound(first, samples, sparse)
        if not sound:
            return
        angle, error = dense[self._encoder]["angle_true"][:sound], dense[self._tool]["error"][:sound]
        piece = np.stack([angle, error])[:, that_count(angle, error)]
        if not self._tail.size:
            self._before = turns_before(piece[0], first)
            self._start = 2.0 * np.pi * self._before
        if self._head.size == 0 or np.ptp(self._head[0]) < _TOGETHER * 2.0 * np.pi:
            self._head = np.concatenate([self._head, piece], axis=1)
        self._tail = np.concatenate([self._tail, piece], axis=1)
        # Filters need the revolutions before the last one; older ones are dropped to limit memory use.
        past = int(self._tail[0, -1] / (2.0 * np.pi)) - _TOGETHER
        if past > self._before:
            self._before = past
            self._tail = self._tail[:, int(np.searchsorted(self._tail[0], past * 2.0 * np.pi)) :]

    def numbers(self) -> dict[str, Any] | None:
        """Return the revolution count and the figures for the first and last one; None without a complete one."""
        head = measure(self._head[0] - self._start, self._head[1], roundness_cutoff=_CUTOFF)
        if not head.form.rms.size:
            return None
        tail = measure(self._tail[0] - self._before * 2.0 * np.pi, self._tail[1], roundness_cutoff=_CUTOFF)
        revolutions = self._before + int(tail.form.rms.size)
        return {
            "revolutions": revolutions,
            "first": numbers(head, 0) | {"revolution": round(self._start / (2.0 * np.pi)) + 1},
            "last": numbers(tail, -1) | {"revolution": revolutions},
        }


def write_profile(path: Path, recording: Recording, found: Measurement, revolutions: list[int]) -> None:
    """Write the radius deviations of revolutions as CSV, with the heights along the part if there was a feed."""
    heights = None
    if len(revolutions) > 1:
        height = recording.of_type(messages.TOOL)["height"]
        starts = found.form.starts
        heights = np.array([height[starts[k] : starts[k + 1]].mean() for k in revolutions])
        if np.ptp(heights) == 0.0:
            heights = None
    radius = found.profile[revolutions] if len(revolutions) > 1 else found.profile[revolutions[0]]
    named = ", ".join(str(k + 1) for k in revolutions)
    profile_csv.write(path, radius, heights=heights, comment=f"deviation from the desired form, revolution {named}")
