# SPDX-License-Identifier: Apache-2.0
"""Result of a run."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lathe_rc.analysis.metrology import Lay, Measurement
from lathe_rc.analysis.tolerance import Growth, Verdict
from lathe_rc.blocks.latency_histogram import Lateness
from lathe_rc.cell.parameters import judged
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.scenario import Scenario
from lathe_rc.drawing import html
from lathe_rc.errors import InputError
from lathe_rc.judge import part
from lathe_rc.signals.form_errors import FormErrors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lathe_rc.analysis.cycle_factors import DriveMargin
    from lathe_rc.event_log import LogEntry
    from lathe_rc.judge.loops import LoopResult


Mode = Literal["offline", "composed", "processes"]
Event = Mapping[str, Any]  #: event of a cell, as reported by a node or the harness


@dataclass(frozen=True, repr=False)
class Result:
    """Result of a run.

    Attributes:
        scenario: the scenario of the run.
        mode: host of the run.
        samples: number of samples.
        wall_s: wall time from block 0 until every member has computed and recorded the last block [s].
        bag: path of the bag; None if nothing or only snapshots were recorded.
        snapshots: bags of sections of the run (see `lathe_rc.bag.writing.snapshots`).
        recording: all signals of the run.
        refused: number of messages from outside the cell that the nodes rejected, by sender.
        not_reached: events scheduled after the end of the run, by node.
        unchecked: properties that the pre-start check could not verify, because third-party laws or drives do not
            declare them.
        warnings: suspicious but allowed parameters, and settings that make the form error larger than necessary, each
            with a remedy, as found by the pre-start check.
        margins: stability margin by learning controller: 1 minus the largest factor per cycle over all frequencies
            and speeds (sup|Q - γZ| for repetitive control) [1]; None for a law without a factor.
        drive_margins: smallest relative error of the drive's response, at one frequency, with which learning diverges,
            by learning controller.
        lateness: lateness of the blocks; None if the run was not paced, that is offline or with ``speed_factor`` 0.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=20"])
        >>> result = lathe_rc.run(piston)
        >>> result
        <Result of piston: offline, 20 revolutions, form error 150.8 to 0.5639 µm RMS, no bag>
        >>> print(f"at most {result.errors.largest[-1] * 1e6:.3f} µm in the last revolution")
        at most 0.992 µm in the last revolution
        >>> result.digest["/tool"] == result.recording.digests()["/tool"]
        True
        >>> error = result.frame("/tool")["error"]  # [m], of each sample
        >>> result.plot().savefig("piston.png")
    """

    scenario: Scenario
    mode: str
    samples: int
    wall_s: float
    bag: Path | None
    snapshots: tuple[Path, ...]
    recording: Recording
    refused: Mapping[str, int] = field(default_factory=dict)
    not_reached: Mapping[str, Sequence[str]] = field(default_factory=dict)
    unchecked: Sequence[str] = ()
    warnings: Sequence[str] = ()
    margins: Mapping[str, float | None] = field(default_factory=dict)
    drive_margins: "Mapping[str, DriveMargin]" = field(default_factory=dict)
    lateness: Lateness | None = None

    def __repr__(self) -> str:
        """Return the scenario and its result in one line."""
        bag = f"bag {self.bag}" if self.bag else "no bag"
        told = [self.mode, self.recording.turned(), *self._errors_told(), bag]
        return f"<Result of {self.scenario.name}: {', '.join(told)}>"

    def _errors_told(self) -> list[str]:
        """Describe the form error, or without a part the errors of the loops, in the first and the last revolution."""
        if self.errors.rms.size:
            return self.errors.told()
        return [line for loop in self.loops.values() for line in loop.told()]

    def _repr_html_(self) -> str:
        """Return the result as an HTML table with the form error by revolution, for notebooks."""
        rows = [("scenario", self.scenario.name), ("host", self.mode)]
        rows += [("length", f"{self.simulated_s:.4g} s, {self.recording.turned()}")]
        rows += [(" ".join(words[:2]), " ".join(words[2:])) for words in map(str.split, self._errors_told())]
        rows += [("bag", str(self.bag or "none"))]
        return html.table((), rows) + self.recording.errors_picture()

    def frame(self, topic: str) -> Any:
        """Return a topic as a table with one row per sample or message (`lathe_rc.cell.recording.Recording.frame`)."""
        return self.recording.frame(topic)

    def plot(self, title: str | None = None) -> "Figure":
        """Plot the desired form, and the form error over angle and by revolution (`lathe_rc.drawing.form.draw`).

        Args:
            title: title of the figure; None: the scenario's name.
        """
        return self.recording.plot(self.scenario.name if title is None else title)

    @property
    def blocks(self) -> int:
        """Number of blocks that the spindle sent."""
        return -(-self.samples // self.scenario.shared.block_size)

    @property
    def dropped(self) -> int:
        """Number of blocks lost by any member: always 0, since a run with losses raises LossyRunError."""
        return 0

    @property
    def simulated_s(self) -> float:
        """Simulated time of the run [s]."""
        return self.samples * self.scenario.shared.step

    @property
    def real_time_factor(self) -> float:
        """Ratio of simulated to wall time."""
        return self.simulated_s / self.wall_s

    @property
    def errors(self) -> FormErrors:
        """Form error by revolution; it has no revolutions if the scenario has no tool."""
        return self.recording.errors

    @cached_property
    def part(self) -> Measurement:
        """Workshop measurements of the part (`lathe_rc.judge.part`)."""
        return part.measured(self.recording)

    @cached_property
    def verdict(self) -> Verdict | None:
        """Whether the part is within tolerance; None if the scenario's tool has no ``tolerance``."""
        return part.verdict(self.scenario, self.recording)

    @property
    def growth(self) -> Growth | None:
        """Growth of a diverging or otherwise growing form error; None if it does not grow."""
        return part.error_growth(self.recording.form)

    @cached_property
    def loops(self) -> "dict[str, LoopResult]":
        """Results of the force and position loops, by controller (`lathe_rc.judge.loops`)."""
        declared = judged(self.scenario.nodes)
        if all(each.quantity == "form" for each in declared.values()):
            return {}
        from lathe_rc.judge import loops

        return loops.evaluated(loops.loops(declared), self.recording)

    @cached_property
    def surface(self) -> Lay | str | None:
        """Surface along the part, or why it is absent; None if no tool of the scenario has a `nose_radius`."""
        radius = part.nose_radius(judged(self.scenario.nodes))
        if not radius or not self.errors.rms.size:
            return None
        try:
            return part.surface(self.recording, self.part, radius)
        except InputError as error:
            return str(error)

    @cached_property
    def digest(self) -> dict[str, str]:
        """Digest of each signal topic, by topic name."""
        return self.recording.digests()

    @cached_property
    def event_log(self) -> "list[LogEntry]":
        """Log of the run's events, alarms and reactions, in order."""
        from lathe_rc.event_log import entries

        return entries(self.recording)

    def summary(self) -> dict[str, object]:
        """Return the output of ``lathe run --json``."""
        errors, step, verdict, growth = self.errors, self.scenario.shared.step, self.verdict, self.growth

        def of(revolution: int) -> dict[str, Any] | None:
            return part.numbers(self.part, revolution) if errors.rms.size else None

        return {
            "scenario": self.scenario.name,
            "mode": self.mode,
            "first_sample": self.recording.first,
            "simulated_s": self.simulated_s,
            "wall_s": self.wall_s,
            "real_time_factor": self.real_time_factor,
            "revolutions": self.recording.revolutions,
            "blocks": self.blocks,
            "dropped": self.dropped,
            "lateness_s": asdict(self.lateness) if self.lateness else None,
            "refused": dict(self.refused),
            "events": [
                {"sample": found.sample, "time": found.sample * step, "topic": found.topic, "text": found.text}
                for found in self.event_log
            ],
            "not_reached": {node: list(events) for node, events in self.not_reached.items()},
            "unchecked": list(self.unchecked),
            "warnings": list(self.warnings),
            "stability_margin": dict(self.margins),
            "drive_margin": {
                name: {**margin._asdict(), "error": margin.error if math.isfinite(margin.error) else None}
                for name, margin in self.drive_margins.items()
            },
            "error_um": {
                "first": of(0),
                "last": of(-1),
                "per_revolution_rms": (errors.rms * 1e6).tolist(),
                "per_revolution_peak_to_valley": (errors.peak_to_valley * 1e6).tolist(),
                "per_revolution_ront": (self.part.roundness.peak_to_valley * 1e6).tolist() if errors.rms.size else [],
            },
            "not_measured": self.recording.sound_form[1] or None,
            "tolerance_um": verdict.summary() if verdict else None,
            "growth_um": growth.summary() if growth else None,
            "loops": {node: loop.summary() for node, loop in self.loops.items()},
            "along_um": part.along(self.surface) if isinstance(self.surface, Lay) else self.surface,
            "bag": str(self.bag) if self.bag else None,
            "snapshots": [str(path) for path in self.snapshots],
            "digest": self.digest,
        }
