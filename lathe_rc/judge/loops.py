# SPDX-License-Identifier: Apache-2.0
"""Results of the force and position loops of a run: figures and verdict from the messages of their controllers."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from lathe_rc import messages
from lathe_rc.analysis.loop_errors import LoopErrors, RunningLoop, SetPointStep
from lathe_rc.analysis.tolerance import FORCE, LAST, POSITION, Growth, Quantity, Verdict, judge, swing_growth
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.judged import Judged
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.soundness import Soundness, fields_of
from lathe_rc.messages import Signals, full
from lathe_rc.signals.form_errors import turns_before

_PIECE = 2**16  # samples evaluated at a time
_AWAY = 0.25  # share of the samples at a limit from which on a growing error diverges
_FAILURES = {
    "swings": "{} loop diverges: its command swings between its limits",
    "runs away": "{} loop diverges: its command stays at a limit against the error",
    "out of reach": "set point of the {} out of reach: the command stays at a limit",
}


@dataclass(frozen=True)
class ServoLoop:
    """Force or position loop of a cell.

    Attributes:
        node: its controller.
        topic: relative topic of the controller's messages.
        quantity: quantity whose error is judged.
        delay: age of the measurement in the messages' error [sample].
        limit: command from which on it is saturated.
        tolerance: allowed error to each side, in SI units; 0: not judged.
        step: sampling step [s].
    """

    node: str
    topic: str
    quantity: Quantity
    delay: int
    limit: float
    tolerance: float
    step: float

    @property
    def name(self) -> str:
        """Controlled quantity."""
        return self.quantity.error.removesuffix(" error")

    def running(self, before: int) -> RunningLoop:
        """Return an accumulator of the loop's behaviour; ``before``: number of revolutions before the first one."""
        return RunningLoop(before, self.delay, self.limit, self.tolerance)


_QUANTITIES = {"force": FORCE, "position": POSITION}


def loops(declared: Mapping[str, Judged]) -> list[ServoLoop]:
    """Return the force and position loops among what nodes declare that a run is judged by."""
    return [
        ServoLoop(node, each.topic, _QUANTITIES[each.quantity], each.delay, each.limit, each.tolerance, each.step)
        for node, each in declared.items()
        if each.quantity in _QUANTITIES
    ]


@dataclass(frozen=True)
class LoopResult:
    """Result of a loop in a run.

    Attributes:
        loop: the loop.
        found: its behaviour by revolution.
        before: number of revolutions before the first one.
        why: reason why the loop was not evaluated to the end of the run; empty if it was.
    """

    loop: ServoLoop
    found: LoopErrors
    before: int = 0
    why: str = ""

    @property
    def verdict(self) -> Verdict | None:
        """Whether the error is in tolerance; None without a tolerance."""
        loop = self.loop
        if not loop.tolerance:
            return None
        return judge(self.found.errors.largest, loop.tolerance, self.before, loop.quantity, unjudged=self.why)

    @cached_property
    def growth(self) -> Growth | None:
        """Growth of the error; it also diverges if the command is at its limits a quarter of the time at the end."""
        grown = swing_growth(self.found.errors.largest, self.before, self.loop.quantity)
        if grown and self.found.saturated[-LAST:].mean() >= _AWAY:
            return replace(grown, diverges=True)
        return grown

    @property
    def diverges(self) -> bool:
        """Whether the loop is unstable: its error diverges, or its command swings between its limits or runs away."""
        limits = self.found.limits
        return bool((self.growth and self.growth.diverges) or (limits and limits.state in ("swings", "runs away")))

    def told(self) -> list[str]:
        """Describe the error in the first and the last revolution as a text line; none without a revolution."""
        quantity = self.loop.quantity
        return self.found.errors.told(quantity.error, quantity.unit, quantity.scale)

    def judged(self) -> Iterator[tuple[str, bool | None]]:
        """Yield the statements on growth, swings and tolerance, and whether each is good; None: neither."""
        loop, errors = self.loop, self.found.errors
        if grown := self.growth:
            yield grown.told(), False
        limits = self.found.limits
        if limits and limits.state:
            shares = f"{limits.upper:.0%} and {limits.lower:.0%} of the time since revolution {limits.since}"
            yield f"{_FAILURES[limits.state].format(loop.name)} ({shares})", False
        if verdict := self.verdict:
            yield verdict.told(), verdict.in_tolerance
        elif self.why:
            yield self.why, False
        elif errors.rms.size:
            last = loop.quantity.told(float(errors.largest[-LAST:].max()))
            yield f"no tolerance is set; error at most {last} in the last {min(errors.rms.size, LAST)}", None
        else:
            yield "no complete revolution", None

    def behaviour(self) -> Iterator[str]:
        """Yield the statements on steady state, step, reversals and limits."""
        found, told, step_s = self.found, self.loop.quantity.told, self.loop.step
        if steady := found.steady:
            low, high = steady.set_point
            where = f"in revolutions {steady.over[0]} to {steady.over[1]}"
            spread = f"error {told(steady.error, 3)}, standard deviation {told(steady.deviation, 3)}, {where}"
            if low == high:
                yield f"set point {told(low)}, {self.loop.name} {told(steady.mean, 5)}: {spread}"
            else:
                yield f"set point from {told(low)} to {told(high)}: {spread}"
        if step := found.step:
            beyond = f"overshoot {told(step.overshoot, 3)} ({abs(step.overshoot / step.change):.2%})"
            band = f"within ±{told(step.band, 3)}"
            settles = f"not {band}" if step.settling is None else f"{band} after {step.settling * step_s:.4g} s"
            yield f"step of {told(step.change)} at {step.start * step_s:.4g} s: {beyond}, {settles}"
        if found.reversals:
            yield f"{found.reversals} reversals of the set point, error at most {told(found.glitch)} after them"
        if found.saturated.any():
            held = found.held.mean()
            yield f"command at a limit {found.saturated.mean():.2%} of the time; anti-windup {held:.2%}"

    def row(self, revolution: int) -> dict[str, Any]:
        """Return the figures of a revolution, counted from 0, in the quantity's unit."""
        errors, scale = self.found.errors, self.loop.quantity.scale
        return {
            "revolution": revolution % errors.rms.size + 1 + self.before,
            "rms": float(errors.rms[revolution]) * scale,
            "max": float(errors.largest[revolution]) * scale,
            "peak_to_valley": float(errors.peak_to_valley[revolution]) * scale,
            "mean": float(self.found.mean[revolution]) * scale,
        }

    def summary(self) -> dict[str, Any]:
        """Return the result for JSON, in the quantity's unit."""
        found, scale, step_s = self.found, self.loop.quantity.scale, self.loop.step
        errors, steady, step = found.errors, found.steady, found.step
        grown, verdict = self.growth, self.verdict
        return {
            "quantity": self.loop.name,
            "unit": self.loop.quantity.unit,
            "first": self.row(0) if errors.rms.size else None,
            "last": self.row(-1) if errors.rms.size else None,
            "per_revolution_rms": (errors.rms * scale).tolist(),
            "per_revolution_max": (errors.largest * scale).tolist(),
            "steady": steady
            and {
                "over_revolutions": list(steady.over),
                "set_point": [value * scale for value in steady.set_point],
                "mean": steady.mean * scale,
                "error": steady.error * scale,
                "deviation": steady.deviation * scale,
            },
            "step": step
            and {
                "at_s": step.start * step_s,
                "change": step.change * scale,
                "overshoot": step.overshoot * scale,
                "band": step.band * scale,
                "settling_s": None if step.settling is None else step.settling * step_s,
            },
            "reversals": {"count": found.reversals, "max": found.glitch * scale} if found.reversals else None,
            "saturated": float(found.saturated.mean()) if errors.rms.size else None,
            "anti_windup": float(found.held.mean()) if errors.rms.size else None,
            "not_measured": self.why or None,
            "tolerance": verdict.summary() if verdict else None,
            "growth": grown.summary() if grown else None,
            "limits": found.limits and {**asdict(found.limits), "state": found.limits.state},
            "diverges": self.diverges,
        }


def _step(of: Callable[[SetPointStep, float], float | None]) -> Callable[[LoopResult], float | None]:
    return lambda result: of(result.found.step, result.loop.step) if result.found.step else None


#: figures of a loop for tables, in SI units, None where there is none; and their units, empty for that of the error
FIGURES: Mapping[str, tuple[Callable[[LoopResult], float | None], str]] = {
    "max_error": (lambda result: float(result.found.errors.largest[-1]), ""),
    "rms_error": (lambda result: float(result.found.errors.rms[-1]), ""),
    "in_tolerance_from": (lambda result: (result.verdict and result.verdict.since) or None, "revolutions"),
    "steady_error": (lambda result: result.found.steady.error if result.found.steady else None, ""),
    "steady_deviation": (lambda result: result.found.steady.deviation if result.found.steady else None, ""),
    "overshoot": (_step(lambda step, _: step.overshoot), ""),
    "settling": (_step(lambda step, period: None if step.settling is None else step.settling * period), "s"),
    "reversal_error": (lambda result: result.found.glitch if result.found.reversals else None, ""),
    "saturated": (lambda result: float(result.found.saturated.mean()), "1"),
    "anti_windup": (lambda result: float(result.found.held.mean()), "1"),
    "diverges": (lambda result: float(result.diverges), "1"),
}


class LoopWatch:
    """Sink that evaluates a loop chunk by chunk (see `lathe_rc.cell.engine.Sink`).

    Args:
        loop: the loop.
        encoder, topic: names of the topics with the angle and with the controller's messages.
        measured: signals that the controller measures, as ``/TOPIC.FIELD``.

    Attributes:
        loop: see the arguments.
        topics: topics that the sink reads.
    """

    def __init__(self, loop: ServoLoop, encoder: str, topic: str, measured: Collection[str] = ()) -> None:
        self.loop, self.topics = loop, (encoder, topic)
        self._soundness = Soundness({*measured, *(f"{full(topic)}.{field}" for field in ("set_point", "error"))})
        self._before = 0
        self._running: RunningLoop | None = None

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add consecutive samples."""
        encoder, topic = self.topics
        sound = self._soundness.sound(first, dense[encoder]["angle_true"].size, sparse)
        angle, servo = dense[encoder]["angle_true"][:sound], dense[topic]
        if self._running is None:
            self._before = turns_before(angle, first)
            self._running = self.loop.running(self._before)
        if sound:
            self._running.add(angle, *(servo[name][:sound] for name in ("set_point", "error", "command")))

    def result(self) -> LoopResult:
        """Return the result of the loop, as if the run ended after the samples so far."""
        running = self._running or self.loop.running(0)
        return LoopResult(self.loop, running.found(), self._before, self._soundness.why)


def watches(found: Sequence[ServoLoop], types: Mapping[str, str]) -> list[LoopWatch]:
    """Return a sink for each loop whose messages are among topics with these message types, together with an angle."""
    encoder = next((topic for topic, kind in types.items() if kind == messages.ENCODER), None)
    named = ((loop, next((topic for topic in types if full(topic).endswith(f"/{loop.topic}")), None)) for loop in found)
    forces = fields_of(types, {(messages.CUT, "measured_force")})
    deflections = fields_of(types, {(messages.CUT, "deflection")})
    return [
        LoopWatch(
            loop,
            encoder,
            topic,
            forces
            if loop.quantity is FORCE
            else {*deflections, f"{full(topic).rpartition('/')[0]}/state.measured_position"},
        )
        for loop, topic in named
        if encoder and topic
    ]


def evaluated(found: list[ServoLoop], recording: Recording) -> dict[str, LoopResult]:
    """Return the results of loops whose messages a recording contains, by controller."""
    made = watches(found, {topic: recording.types[topic] for topic in recording.dense})
    for start in range(0, recording.samples if made else 0, _PIECE):
        piece = slice(start, start + _PIECE)
        for watch in made:
            dense = {
                topic: {name: samples[piece] for name, samples in recording.dense[topic].items()}
                for topic in watch.topics
            }
            watch.chunk(recording.first + start, 0, dense, {} if start else recording.events)
    found_by = {watch.loop.node: watch.result() for watch in made}
    return {node: replace(result, why=result.why or recording.lost) for node, result in found_by.items()}
