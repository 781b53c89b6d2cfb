# SPDX-License-Identifier: Apache-2.0
"""Real encoder as time master: the spindle motion follows from its counts, live or from a file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from lathe_machine.signals import count_checks
from lathe_machine.signals.counts import MOST_COUNT, CountedAngle, CsvReader, Reading
from lathe_machine.stages.common.tables import made_of
from lathe_rc import messages, resources
from lathe_rc.blocks.ports import Joint, Output, Sparse
from lathe_rc.cell.parameters import NonNegative, Positive, parameter
from lathe_rc.cell.time_master import TimeMaster, TimeMasterParameters
from lathe_rc.errors import InputError, LatheError, at_most
from lathe_rc.messages import Samples, Signals

TOO_FAST, TOO_SLOW, LATE = "too fast", "too slow", "late"  #: events that come about by themselves

_TURN = 2.0 * np.pi
_RPM = 30.0 / np.pi  # rpm per rad/s
_FEWEST = 8  # readings of a file whose speed is looked at


class EncoderDeviceParameters(TimeMasterParameters):
    """Real encoder in place of the spindle: source of the counts, and length and pace of the run.

    The angle is linear between readings; the measured angle counts as the true one. A topic or a line sets the pace
    itself: `speed_factor` applies to files only.
    """

    counts_per_revolution: Annotated[int, Ge(1), Le(2**31 - 1)] = parameter(
        4096, "encoder counts per revolution after quadrature"
    )
    edge_clock: Annotated[float, Ge(0), Le(1)] = parameter(
        0.0,
        "line, file: each reading has the time of its last edge, rounded down to this resolution; topic: the position "
        "has parts of a count, from such times; 0: neither",
        "s",
    )
    source: Literal["topic", "line", "file"] = parameter(
        "topic", "sensor_msgs/JointState on a topic; lines of text from a serial line, pipe or file; or a CSV file"
    )
    topic: str = parameter("spindle/joint_states", "topic: its name; nobody else in the cell reads it")
    joint: str = parameter("", "topic: name of the joint; empty: the first one")
    position: Literal["angle", "counts"] = parameter("angle", "topic: what its position is, in rad or counts")
    device: str = parameter(
        "", "line: path of the terminal, pipe or file, with lines of time_ns,counts (edge_clock: and edge_ns)"
    )
    baud_rate: Annotated[int, Ge(50)] = parameter(115200, "line: speed of a terminal, in baud", "1/s")
    counts_file: str = parameter(
        "",
        "file: CSV file with time_ns,counts or time_s,counts (edge_clock: and edge_ns), perhaps also index_counts or "
        "index_ns",
        path=True,
    )
    counter_range: Annotated[int, Ge(0)] = parameter(0, "the counter begins anew after so many counts; 0: never")
    inverted: bool = parameter(default=False, doc="the counter counts down while the spindle turns forward")
    max_reverse: NonNegative = parameter(
        2.0, "counts that the counter may go back by; the angle stands still meanwhile"
    )
    max_forward: NonNegative = parameter(
        0.1, "angle that the counter may run ahead of a spindle at twice the nominal speed; more is an error", "rad"
    )
    max_gap: Positive = parameter(0.01, "longest time between two readings; a longer one is an error", "s")
    max_silence: Positive = parameter(1.0, "topic, line: longest wall time without a reading; longer is an error", "s")
    max_lag: Positive = parameter(
        0.5, "topic, line: how far the cell may fall behind the readings; farther is an error", "s"
    )
    max_deviation: Annotated[float, Gt(0), Lt(1)] = parameter(
        0.2, "the checks before the start count on speeds this near to the nominal one; events report others", "1"
    )
    max_acceleration: NonNegative = parameter(
        200.0, "the checks before the start count on no greater acceleration of the spindle", "rad/s^2"
    )


class EncoderDevice(TimeMaster):
    """Time master that follows the counts of a real encoder (see `lathe_machine.signals.counts`).

    Attributes:
        counted: angle from the counts.
    """

    kind = "encoder_device"
    Parameters = EncoderDeviceParameters
    parameters: EncoderDeviceParameters
    announces = (TOO_FAST, TOO_SLOW, LATE)

    def __init__(self, name: str, parameters: EncoderDeviceParameters) -> None:
        super().__init__(name, parameters)
        self.live = parameters.source != "file"
        counts, wraps = parameters.counts_per_revolution, parameters.counter_range
        self.counted = made_of(CountedAngle, parameters, counts=counts, wraps=wraps)
        self._before: Samples | None = None  # latest angles, for the speed
        self._speed = self.shared.nominal_speed  # latest speed [rad/s]
        self._revolution = -1.0
        self._told: set[str] = set()
        self._told_late = 0
        self._doubts: list[str] = []
        self._check()
        if not self.live:
            self._read(resources.find(Path(parameters.counts_file)))
        self.place_triggers()
        if parameters.source == "topic":
            self.foreign = {parameters.topic: messages.JOINTS}
        self.declare(outputs=[Output("encoder", messages.ENCODER, Joint("angle", "speed"))], tells=True)

    def _check(self) -> None:
        parameters, source = self.parameters, self.parameters.source
        needed = {"topic": "topic", "line": "device", "file": "counts_file"}[source]
        if not getattr(parameters, needed):
            raise InputError(f"{self.name}.{needed} is empty with source = {source}; allowed: a name")
        if self.live and parameters.simulation_services:
            raise InputError(
                f"{self.name}.simulation_services = {parameters.simulation_services!r} with source = "
                f"{parameters.source}; allowed: none, since nobody can hold the spindle"
            )
        if self.live and parameters.speed_factor != 1.0:
            raise InputError(
                f"{self.name}.speed_factor = {parameters.speed_factor:g} with source = {source}; allowed: 1, since the "
                "encoder sets the pace"
            )

    def _read(self, path: Path) -> None:
        reader = CsvReader(path)
        self._check_edges(path, timed=reader.timed)
        readings = list(reader.read())
        try:
            self._check_file(reader, readings)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        for place, reading in enumerate(readings):
            try:
                self.counted.add(*reading)
            except LatheError as error:
                raise InputError(f"{path}:{reader.numbers[place]}: {error}{reader.torn(place)}") from None
            if self.counted.late:
                late = "a reading that is not later than the one before; allowed: times that rise"
                raise InputError(f"{path}:{reader.numbers[place]}: {late}{reader.torn(place)}")
        self.end()
        if self.samples is None:
            raise InputError(self._too_short(str(path)))

    def _check_file(self, reader: CsvReader, readings: Sequence[Reading]) -> None:
        """Check stamps, speed and index pulses of a file, and turn its angle to the index.

        Raises:
            InputError: they contradict the parameters.
        """
        parameters, shared = self.parameters, self.shared
        times, counts = [reading[0] for reading in readings], [reading[1] for reading in readings]
        if len(readings) < _FEWEST or not all(abs(count) <= MOST_COUNT for count in counts):
            return  # adding the readings tells what is wrong
        time = np.array([at - times[0] for at in times], dtype=float) * 1e-9
        wraps, inverted, of = parameters.counter_range, parameters.inverted, parameters.counts_per_revolution
        turned = count_checks.turned_by(counts, wraps, inverted=inverted)
        count_checks.check_stamps(time, turned)
        speed = count_checks.typical_speed(time, turned, of, shared.nominal_speed / _TURN)
        doubt = ""
        if speed is not None:
            doubt = count_checks.check_speed(60.0 * speed, shared.nominal_rpm, of, parameters.max_deviation)
        if reader.index:
            timed = reader.index != "counts"
            at = count_checks.index_counts(reader.pulses, times, counts, turned, wraps, timed=timed, inverted=inverted)
            few = count_checks.check_index(at, of, parameters.max_reverse)
            doubt = f"{few}; {doubt}".rstrip("; ") if few else ""
            self.counted.zero = float(at[0]) if at.size else None
        self._doubts = [f"{self.name}.counts_file = {parameters.counts_file}: {doubt}"] if doubt else []

    def _check_edges(self, path: Path, *, timed: bool) -> None:
        """Check that a file has the times of edges if, and only if, their resolution is given."""
        clock = self.parameters.edge_clock
        if timed and not clock:
            raise InputError(
                f"{self.name}.edge_clock = 0, and {path} has times of edges; allowed: their resolution, such as 1e-6"
            )
        if clock and not timed:
            raise InputError(
                f"{self.name}.edge_clock = {clock:g} s, and {path} has no times of edges; allowed: 0, or a third "
                "column edge_ns or edge_s"
            )

    def _too_short(self, what: str) -> str:
        return (
            f"{what} ends at {self.counted.time:.6g} s, after {at_most(self.counted.angle / _TURN)} revolutions; "
            f"{self.name}.revolutions = {self.parameters.revolutions:g}, allowed: up to that, or 0 for all there is"
        )

    def warnings(self, seconds: float) -> list[str]:
        """Return the warnings about the file of counts."""
        return self._doubts

    # ---- readings -----------------------------------------------------------------------------------

    def hear(self, time_ns: int, count: float, edge_ns: int | None = None) -> None:
        """Append a reading: its time [ns], the counter and, if known, the time of its last edge [ns].

        Raises:
            LatheError: the reading is invalid; the message names the node.
        """
        with self.named():
            self.counted.add(time_ns, count, edge_ns)
        self._look_for_the_end()

    def end(self) -> None:
        """Mark the end of the readings.

        Raises:
            LatheError: the run should have been longer.
        """
        self._look_for_the_end()
        if self.samples is None and not self.parameters.revolutions:
            self.samples = self.counted.available
        if self.samples is None and self.live:
            raise LatheError(self._too_short(f"{self.name}: the line"))

    def go_on(self) -> None:
        """Continue at the last speed after a loss of the encoder, so that the cell can go to its safe state."""
        self.counted.go_on(self._speed)

    def _look_for_the_end(self) -> None:
        wanted = _TURN * self.parameters.revolutions
        if wanted and self.samples is None and self.counted.angle >= wanted:
            self.samples = self.counted.reached(wanted)

    @property
    def available(self) -> int:
        """Number of samples that can be computed."""
        return self.counted.available if self.samples is None else self.samples

    # ---- for the checks before a start --------------------------------------------------------------

    def sample_at(self, angle: float) -> int:
        """Return the first sample at which the readings have reached an angle [rad]; later readings do not matter."""
        found = None if self.live else self.counted.reached(angle)
        if found is None:
            where = f"{angle / _TURN:g} revolutions"
            if self.live:
                raise InputError(
                    f"{self.name}: nobody knows when {where} will be reached; allowed with source = "
                    f"{self.parameters.source}: events by second or sample"
                )
            raise InputError(f"{self.name}: an event at {where}; allowed: up to {at_most(self.counted.angle / _TURN)}")
        return found

    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed in the run [rad/s]."""
        nominal, deviation = self.shared.nominal_speed, self.parameters.max_deviation
        return nominal * (1.0 - deviation), nominal * (1.0 + deviation)

    def largest_acceleration(self) -> float:
        """Upper bound of the magnitude of dΩ/dt in the run [rad/s²]."""
        return self.parameters.max_acceleration

    # ---- samples ------------------------------------------------------------------------------------

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute angle and speed of the samples from the readings."""
        out = outputs[0]
        if not out["angle"].size:
            return []
        angle = self.counted.take(first, out["angle"].size)
        window, step = self.parameters.speed_window, self.shared.step
        if self._before is None:
            # Before the first reading the spindle is assumed to turn at nominal speed.
            self._before = angle[0] + self.shared.nominal_speed * step * np.arange(-window, 0)
        whole = np.concatenate((self._before, angle))
        out["angle"][:] = out["angle_true"][:] = angle
        out["speed"][:] = out["speed_true"][:] = (angle - whole[: angle.size]) / (window * step)
        self._before = whole[-window:].copy()
        self._speed = float(out["speed"][-1])
        turns = np.floor(angle / _TURN)
        out["index_pulse"][:] = turns > np.concatenate(([self._revolution], turns[:-1]))
        self._revolution = float(turns[-1])
        return self._say(first, out["speed"])

    def _say(self, first: int, speed: Samples) -> list[Sparse]:
        """Return the events of these samples; those of the speed only once."""
        low, high = self.speed_range()
        said = []
        for what, outside in ((TOO_FAST, speed > high), (TOO_SLOW, speed < low)):
            if what not in self._told and outside.any():
                self._told.add(what)
                place = int(np.argmax(outside))
                said.append((first + place, f"{what}: {speed[place] * _RPM:.5g} rpm"))
        if (late := self.counted.late) > self._told_late:
            said.append((first, f"{LATE}: {late - self._told_late} readings after younger ones, left out"))
            self._told_late = late
        topic = f"{self.name}/events"
        return [Sparse(topic, messages.EVENT, index, {"action": text}) for index, text in said]
