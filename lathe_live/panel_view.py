# SPDX-License-Identifier: Apache-2.0
"""View of a run in the panel: the newest values, the form by revolution, and the log; the lamp is beside it.

The cell's thread feeds the view with chunks of samples and publishes a snapshot a few times a second; it never waits
for a reader. Readers take the newest snapshot, and from lists that only grow what they do not have yet, so that a slow
browser misses snapshots and delays nothing.
"""

import math
import threading
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from lathe_live.panel_advice import Situation
from lathe_live.panel_age import Age
from lathe_live.panel_lamp import OUT, Lamp
from lathe_live.panel_outlook import outlook
from lathe_live.panel_timeline import Timeline
from lathe_live.panel_topics import Topics
from lathe_live.panel_verdict import Evaluation
from lathe_live.rerun_part import Outlook, Scale
from lathe_live.rerun_revolutions import ANGLES, DrawnRevolution, Revolutions
from lathe_rc import event_log, messages
from lathe_rc.analysis.tolerance import LAST, Verdict
from lathe_rc.arrays import Array
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.judged import Judged
from lathe_rc.cell.parameters import form_doubt, judged
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.soundness import FORM, Soundness, fields_of
from lathe_rc.cell.stage import Stage
from lathe_rc.errors import InputError, LatheError
from lathe_rc.judge.loops import ServoLoop, loops, watches
from lathe_rc.judge.part import Tolerances, error_growth
from lathe_rc.messages import Samples, Signals, full
from lathe_rc.view.form_limits import Finding, form_limits, varying_speed

CELLS = 180  #: cells of a row of the map
PERIOD = 0.125  #: least time between two snapshots [s]
_REST = 9.0  # least rest after a snapshot, in durations of it: that of a long run takes a tenth of the time at most
MOST_ROWS = 256  #: rows of the map, an even number; when it is full, neighbours are merged
MOST_LOG = 2**13  #: lines of the log; when it is full, the older half is dropped
WATERFALL = 12  #: newest revolutions whose error is shown as curves
_AT_ONCE = 16  # rows in an answer
_STILL = 1.0  # [s] without a new sample from which on a run that is held is paused
_SHAPE = 90  # points of the part's outline
_MOST_LINES = 2000  # of the log in an answer
_UM = 1e6
_RPM = 60.0 / (2.0 * np.pi)


@dataclass(frozen=True)
class MapRow:
    """Revolution in the map, or several that are merged.

    Attributes:
        since, number: numbers of the first and the last revolution.
        height: mean position along the part in the last one [m].
        cells: radius deviation from the desired form, the largest in magnitude in each cell [µm], shape (CELLS,).
        out: whether the supervisor held the tool out of the part in some of it, or in each revolution.
    """

    since: int
    number: int
    height: float
    cells: Array
    out: bool = False

    def merged(self, later: "MapRow") -> "MapRow":
        """Return a row of these and later revolutions; of two, the one without the part does not count."""
        if self.out != later.out:
            cells = (later if self.out else self).cells
        else:
            cells = np.where(np.abs(later.cells) > np.abs(self.cells), later.cells, self.cells)
        return MapRow(self.since, later.number, later.height, cells, self.out and later.out)

    def told(self) -> dict[str, Any]:
        """Return the row as JSON data."""
        place = {"since": self.since, "revolution": self.number, "height": round(self.height * 1e3, 6)}
        return {**place, "cells": _short(self.cells), "out": self.out}


@dataclass(frozen=True)
class Snapshot:
    """State of a run at a sample; the lists belong to the view, and only grow.

    Attributes:
        number: number of the snapshot, counted from 1.
        run: number of the run; lists of another run start anew.
        now: newest values, by name, in the units of the page.
        epoch: number of times that neighbours in the map were merged.
        rows, log: complete rows of the map, lines of the log.
        dropped: number of older lines.
        open: row of the map that is not complete, if there is one.
        latest: newest revolutions.
        radius: radius deviation of the part in the newest one [m], shape (ANGLES,); empty: there is none.
        situation: evaluation of the part, and what advice rests on.
    """

    number: int
    run: int
    now: Mapping[str, Any]
    epoch: int
    rows: list[MapRow]
    open: MapRow | None
    log: list[dict[str, Any]]
    dropped: int
    latest: Sequence[MapRow]
    radius: Array
    situation: Situation


def _short(values: Array) -> list[float]:
    """Return numbers with four digits."""
    return [float(f"{value:.4g}") for value in values.tolist()]


def has_memory(stage: Stage) -> bool:
    """Return whether a stage commands from a memory that can be cleared."""
    return "clear" in stage.actions and any(port.type == messages.COMMAND for port in stage.outputs)


def _row(revolution: DrawnRevolution, *, out: bool) -> MapRow:
    parts = -revolution.error.reshape(CELLS, ANGLES // CELLS)
    largest = np.abs(parts).argmax(axis=1)
    cells = np.nan_to_num(parts[np.arange(CELLS), largest] * _UM)
    return MapRow(revolution.number, revolution.number, revolution.height, cells, out)


class View:
    """View of one run after the other; a sink of the engine.

    Args:
        types: message type by topic.
        step_ns: sampling step [ns].
        margin: stability margin before the first cycle; None: unknown.
        live: whether the cell runs elsewhere.

    Attributes:
        outlook: see `lathe_live.panel_outlook`; empty: unknown.
        memories: learning controllers whose memories can be cleared.
        lamp: state of the supervisor; a sink of its own, since it must not wait for the samples of a live view.
        timeline: extremes by revolution and events; `clear` leaves it, since that of a bag is complete from the start.
        age: age of the samples shown; a live view also tells it the samples that it does not show yet.
    """

    def __init__(
        self, types: Mapping[str, str], step_ns: int, margin: float | None = None, *, live: bool = False
    ) -> None:
        self._news = threading.Condition()
        self._due = 0.0
        self.run = 0
        self.latest: Snapshot | None = None
        self.outlook: Mapping[str, Any] = {}
        self.live, self.lamp, self.age = live, Lamp(live=live), Age()
        self.timeline = Timeline(Topics.of({}))
        self.memories: Collection[str] = ()
        self._loops: Sequence[ServoLoop] = ()
        self._declared: Mapping[str, Judged] = {}
        self._doubt = 0.0  # about the form, see `Tolerances`
        self._part: RunningForm | None = None  # from the first sample of the part on
        self._tolerances = Tolerances()
        self._lasting = {*vars(self), "_lasting"} - {"_part"}  # attributes that are no `state` of a run
        self.begin(types, step_ns, margin)

    def begin(self, types: Mapping[str, str], step_ns: int, margin: float | None = None) -> None:
        """Begin with another run of another cell (arguments as for the class)."""
        self._types: dict[str, str] = {}
        self._form: set[str] = set()  # signals that the form error is made of
        self._step_ns, self._margin = step_ns, margin
        self.learn(types)
        self.timeline.begin(self.topics)
        self.clear(margin)

    def know(self, scenario: Scenario, stages: Iterable[Stage] = ()) -> None:
        """Show what the samples do not tell: tolerance and shape of the scenario, verdict and loops from now on.

        Args:
            scenario: scenario of the cell.
            stages: stages that can be commanded.
        """
        self.memories = [stage.name for stage in stages if has_memory(stage)]
        self._declared, self._doubt = judged(scenario.nodes), form_doubt(scenario.nodes)
        self._part = None
        self.outlook, self._loops = outlook(scenario), loops(self._declared)
        self._watches = watches(self._loops, self._types)
        for loop in self._loops:
            loop.running(0).add(*np.zeros((4, loop.delay + 2)))  # compiles the kernel before the run

    def learn(self, types: Mapping[str, str]) -> None:
        """Add topics."""
        self._types |= {full(topic): kind for topic, kind in types.items()}
        self._form |= fields_of(types, FORM)
        self.topics = Topics.of(self._types)
        self.timeline.learn(self.topics)

    def clear(self, margin: float | None = None) -> None:
        """Begin with another run of the same cell."""
        self.run += 1
        if not self.live:
            self.age.begin()
        self._revolutions, self._soundness = Revolutions(), Soundness(self._form)
        self._now: dict[str, Any] = {"margin": self._margin if margin is None else margin, "learning": {}}
        self._is_out = False
        self._out: tuple[float, float] = (math.inf, math.inf)  # samples in which the tool was last out of the part
        self._complete, self._end = 0, 0  # number of complete revolutions, and sample after the last one
        self._cut_to = 0  # last revolution with the tool in the part
        self._scale: Scale | None = None
        self._epoch, self._joined = 0, 0  # times that rows were merged; revolutions in the open row
        self._rows: list[MapRow] = []
        self._open: MapRow | None = None
        self._newest: list[MapRow] = []
        self._forms: list[DrawnRevolution] = []  # of the newest rows
        self._limits: tuple[int, list[Finding]] = (0, [])  # number of revolutions, and what limits the form error then
        self._part = None
        self._judged: tuple[object, Evaluation] = (None, Evaluation())  # evaluation, and what it rests on
        self._conditions = event_log.Conditions()
        self._speeds = (math.inf, 0.0)  # extremes [rad/s]
        self._watches = watches(self._loops, self._types)
        self._log: list[dict[str, Any]] = []
        self._dropped = 0  # lines before those in the log

    def state(self) -> Mapping[str, Any]:
        """Return the state of the run so far, for `resume`; it goes on changing."""
        return {name: value for name, value in vars(self).items() if name not in self._lasting}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from a copy of a state of the same cell, as another run of it."""
        vars(self).update(state)
        self.run += 1
        self.age.begin()

    @property
    def reached(self) -> int:
        """Sample after the newest."""
        return int(self._now.get("sample", 0))

    def current(self, snapshot: Snapshot) -> dict[str, Any]:
        """Return the values of a snapshot for the page, with state of the supervisor and age of now.

        A run that is held for this panel may be continued by others: it is paused once no samples come.
        """
        lamp = self.lamp.now(supervised=self.supervised, memories=self.memories)
        now: dict[str, Any] = {**snapshot.now, **lamp}
        age = self.age.now(int(now.get("sample", 0)), self._step_ns * 1e-9)
        if self.live and now["state"] == "paused" and (age["still"] or 0.0) < _STILL:
            now["state"] = "running"
        out = lamp["next"]["retract"]["text"] if lamp["next"] and lamp["safety"]["state"] in OUT else ""
        part = snapshot.situation.evaluation.headline(out)
        alarmed = bool(lamp["next"]) and lamp["next"]["reset"]["due"]
        advice = snapshot.situation.advice(self.outlook, alarmed=alarmed)
        return {**now, "age": age, "live": self.live, "part": asdict(part), "advice": advice}

    @property
    def supervised(self) -> bool:
        """Whether the cell has a supervisor, by its scenario or its topics."""
        return bool(self.outlook.get("supervised")) or messages.SAFETY_STATUS in self._types.values()

    @property
    def turns(self) -> float:
        """Spindle angle of the newest sample [revolution]."""
        return float(self._now.get("angle", 0.0)) / (2.0 * np.pi)

    @property
    def was_out(self) -> bool:
        """Whether the supervisor held the tool out of the part in the last revolutions."""
        return any(row.out for row in self._newest[-LAST:])

    # ---- the cell's thread --------------------------------------------------------------------------

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Take consecutive samples, as a sink of the engine."""
        named = {full(topic): signals for topic, signals in dense.items()}
        for message in sorted((each for found in sparse.values() for each in found), key=lambda each: each.index):
            self._message(full(message.topic), message)
        self._now["sample"] = first + samples
        self._now["time"] = (first + samples) * self._step_ns * 1e-9
        self.age.heard(first + samples)
        encoder, tool, cut = (named.get(topic) for topic in (self.topics.encoder, self.topics.tool, self.topics.cut))
        if encoder:
            slowest, fastest = float(encoder["speed_true"].min()), float(encoder["speed_true"].max())
            self._speeds = (min(self._speeds[0], slowest), max(self._speeds[1], fastest))
            self._now |= {"angle": float(encoder["angle_true"][-1]), "rpm": float(encoder["speed"][-1]) * _RPM}
        if cut:
            self._now |= {name: float(cut[name][-1]) for name in ("force", "measured_force")}
        self._now["drives"] = {
            topic.strip("/").removesuffix("/state"): float(named[topic]["position"][-1]) * _UM
            for topic in self.topics.drives
            if topic in named
        }
        self._now["slides"] = {
            axis: float(named[topic]["position"][-1]) * 1e3
            for axis, topic in self.topics.slides.items()
            if topic in named
        }
        for watch in self._watches:
            if named.keys() >= {*watch.topics}:  # a live view does not listen to controllers
                watch.chunk(first, samples, named, sparse)
        before, sound = self._soundness.why, self._soundness.sound(first, samples, sparse)
        if self._soundness.why != before:
            self.say(first + sound, "panel", f"form error {self._soundness.why}")
        self.timeline.chunk(first, samples, named, sparse, sound)
        if encoder and tool:
            self._cut(first, encoder["angle_true"], tool, sound)

    def _cut(self, first: int, angle: Samples, tool: Signals, sound: int) -> None:
        if self._scale is None:
            self._scale = Scale.of(Outlook(), tool["reference"])
        self._now |= {
            name: float(tool[name][-1]) * _UM for name in ("reference", "displacement", "error", "measured_error")
        }
        self._now["height"] = float(tool["height"][-1]) * 1e3
        if sound:
            if self._part is None:
                self._tolerances = Tolerances.of(self._declared, self.topics.tool, self._doubt)
                self._part = RunningForm(self.topics.encoder, self.topics.tool, self._soundness, self._tolerances.zones)
            self._part.add(first, angle[:sound], {name: signal[:sound] for name, signal in tool.items()})
            fields = (tool[name][:sound] for name in ("error", "reference", "height"))
            self._add(self._revolutions.add(first, angle[:sound], *fields))

    def finish(self) -> None:
        """Show the last revolution as well, at the end of a run."""
        self._add(self._revolutions.finish())

    def _add(self, complete: Iterable[DrawnRevolution]) -> None:
        for revolution in complete:
            row = _row(revolution, out=revolution.end > self._out[0] and self._end < self._out[1])
            self._end = revolution.end
            self._complete += 1
            self._cut_to = self._cut_to if row.out else revolution.number
            self._newest = [*self._newest[1 - WATERFALL :], row]
            self._forms = [*self._forms[1 - WATERFALL :], revolution]
            self._open, self._joined = self._open.merged(row) if self._open else row, self._joined + 1
            if self._joined == 2**self._epoch:
                self._rows.append(self._open)
                self._open, self._joined = None, 0
            if len(self._rows) == MOST_ROWS:
                # A new list: readers of older snapshots keep the old one.
                pairs = zip(self._rows[::2], self._rows[1::2], strict=True)
                self._rows, self._epoch = [one.merged(other) for one, other in pairs], self._epoch + 1

    def _message(self, topic: str, message: Sparse) -> None:
        if message.type == messages.LEARNING:
            self._now["learning"] = {**self._now["learning"], topic: bool(message.values["learning"])}
        if message.type == messages.LEARNING and np.isfinite(message.values["stability_margin"]):
            self._now["margin"] = float(message.values["stability_margin"])
        if message.type in event_log.LOGGED:
            self.say(message.index, topic.strip("/"), event_log.text(message))
        if message.type == messages.SAFETY_STATUS:
            out = event_log.supervisor_state(message) in OUT
            if out != self._is_out:
                self._is_out, self._out = out, (message.index, math.inf) if out else (self._out[0], message.index)
        if message.type == messages.EVENT:
            self._conditions.take(message)

    def _evaluated(self, unjudged: str) -> Evaluation:
        """Evaluate the part as ``lathe run`` does; ``unjudged``: reason why its end cannot be judged, or empty."""
        form, rests_on = self._part, (self._part, self._complete, unjudged)
        if form and self._judged[0] != rests_on:
            verdict, until_out = self._tolerances.verdict(form, unjudged), None
            if verdict and 0 <= (cut := self._cut_to - form.before) < verdict.revolutions:
                until_out = self._tolerances.verdict(form, revolutions=cut)
            self._judged = rests_on, Evaluation(verdict, error_growth(form), until_out=until_out)
        found = self._judged[1]
        results = [watch.result() for watch in self._watches]
        told = [(f"{each.loop.node}: {text}", good) for each in results for text, good in each.judged()]
        missing = self._missing(found.verdict)
        return replace(found, missing=missing, loops=[each for each in told if each[1] is not None])

    def _situation(self, unjudged: str) -> Situation:
        """Return the evaluation of the part with what advice on it rests on."""
        return Situation(
            self._evaluated(unjudged),
            np.array([form.error for form in self._forms[-LAST:]]).reshape(-1, ANGLES),
            (self._now["margin"] or 0.0) < 0.0,
            any(each.falls for each in self._limits[1]),
            any(self._now["learning"].values()),
            self.memories,
            sorted(self._conditions.limited),
        )

    def _missing(self, verdict: Verdict | None) -> str:
        """Return which of the revolutions up to now are not judged, or why none is."""
        if not self.topics.tool:
            return "no tool in this cell"
        if not self._declared:
            return "the scenario, and so the tolerance, is not known"
        if self._part is None:
            return "no sample of the part yet"
        if verdict is None:
            node = next((node for node, each in self._declared.items() if each.quantity == "form"), "tool")
            return f"no tolerance: {node}.tolerance = 0"
        last, turns = self._part.before + verdict.revolutions, math.floor(self.turns)
        return f"revolutions {last + 1} to {turns} were not received" if turns > last and not verdict.unjudged else ""

    def _limiting(self) -> list[str]:
        """Return what limits the form error, in sentences."""
        forms = self._forms[-LAST:]
        if self._limits[0] != self._complete and forms:
            tolerance = self.outlook.get("tolerance")
            found = form_limits(
                np.array([form.error for form in forms]) * _UM,
                excess=forms[-1].largest * _UM / tolerance if tolerance else 0.0,
                learning=messages.LEARNING in self._types.values(),
                causes=[*self.outlook.get("changing", []), *varying_speed(*self._speeds)],
            )
            out = [Finding("The supervisor's retraction makes the form error of the last revolutions.")]
            self._limits = self._complete, out if self.was_out else list(found)
        margin = self._now["margin"]
        return [
            *(f"{node} is at the limits of its command." for node in sorted(self._conditions.limited)),
            *(["Learning diverges: its stability margin is below 0."] if margin is not None and margin < 0.0 else []),
            *(each.text for each in self._limits[1]),
        ]

    def _looped(self) -> list[str]:
        """Return verdict and behaviour of the force and position loops, in sentences."""
        results = (watch.result() for watch in self._watches)
        return [
            f"{result.loop.node}: {text}."
            for result in results
            if result.found.errors.rms.size
            for text in (*(told for told, _ in result.judged()), *result.behaviour())
        ]

    def say(self, sample: int, source: str, text: str, kind: str = "") -> None:
        """Add a line to the log, and with a ``kind`` a mark of it to the timeline."""
        if kind:
            self.timeline.mark(sample, kind, text)
        self._log.append({"sample": sample, "source": source, "text": text[:300]})
        if len(self._log) == MOST_LOG:
            self._log, self._dropped = self._log[MOST_LOG // 2 :], self._dropped + MOST_LOG // 2  # a new list, as above

    def know_lost(self, text: str) -> None:
        """Show how many samples were left out so far."""
        self._now["left_out"] = text

    def publish(self, told: Mapping[str, Any], *, at_once: bool = False) -> None:
        """Publish a snapshot, unless the last one was a moment ago.

        Args:
            told: status of the run.
            at_once: whether to publish in any case.
        """
        now = time.monotonic()
        if not at_once and now < self._due:
            return
        with self._news:
            number = self.latest.number + 1 if self.latest else 1
            scale = self._scale.deviation / 1e3 if self._scale else 1.0
            current = {**self._now, **told, "exaggeration": scale}
            current |= {"limits": self._limiting(), "loops": self._looped()}
            why = self._soundness.why or str(told.get("failure") or told.get("lost") or "")
            self.latest = Snapshot(
                number,
                self.run,
                current,
                self._epoch,
                self._rows,
                self._open,
                self._log,
                self._dropped,
                tuple(self._newest),
                self._forms[-1].radius if self._forms else np.empty(0),
                self._situation(why),
            )
            self._news.notify_all()
        done = time.monotonic()
        self._due = max(now + PERIOD, done + _REST * (done - now))

    # ---- readers ------------------------------------------------------------------------------------

    def wait(self, after: int, seconds: float) -> Snapshot:
        """Return the newest snapshot, as soon as its number is not ``after``, or after some seconds.

        Raises:
            LatheError: there is none yet.
        """
        with self._news:
            self._news.wait_for(lambda: self.latest is not None and self.latest.number != after, seconds)
            if self.latest is None:
                raise LatheError("the run has not begun yet")
            return self.latest


@dataclass(frozen=True)
class Have:
    """Contents of a page so far.

    Attributes:
        number: number of its newest snapshot.
        run: number of its run.
        epoch, rows: state of its map, see `Snapshot`.
        log: number of lines, with those that were dropped.
        latest: newest revolution in its waterfall.
    """

    number: int = 0
    run: int = 0
    epoch: int = 0
    rows: int = 0
    log: int = 0
    latest: int = 0

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> "Have":
        """Read the state of a page from its question.

        Raises:
            InputError: a number is missing or negative.
        """
        found: dict[str, int] = {}
        for name in (each.name for each in fields(cls)):
            value = told.get(name)
            if not isinstance(value, int) or not 0 <= value < 2**53:
                raise InputError(f"{name} = {str(value)[:80]}; allowed: a whole number from 0 on")
            found[name] = value
        return cls(**found)


def news(view: View, have: Have, patience: float) -> dict[str, Any]:
    """Return what a page lacks, as JSON data, once there is a new snapshot, or after some seconds; the lamp is current.

    Rows of the map come a few at a time. For each epoch that it has missed, a page first merges its rows in pairs as
    `MapRow.merged` does, and drops the last one of an odd number.

    Raises:
        LatheError: there is no snapshot yet.
    """
    snapshot = view.wait(have.number, patience)
    if have.run != snapshot.run or have.epoch > snapshot.epoch:
        have = Have(have.number)
    had = have.rows >> snapshot.epoch - have.epoch
    rows = snapshot.rows[had : had + _AT_ONCE]
    lines = snapshot.log[max(have.log - snapshot.dropped, 0) :][:_MOST_LINES]
    latest = [row for row in snapshot.latest if row.number > have.latest]
    return {
        "number": snapshot.number,
        "run": snapshot.run,
        "epoch": snapshot.epoch,
        "now": view.current(snapshot),
        "rows": [row.told() for row in rows],
        "open": snapshot.open.told() if snapshot.open else None,
        "more": had + len(rows) < len(snapshot.rows),
        "log": lines,
        "logged": max(have.log, snapshot.dropped) + len(lines),
        "latest": [row.told() for row in latest],
        "shape": _short(snapshot.radius[:: ANGLES // _SHAPE] * _UM) if latest else None,
    }
