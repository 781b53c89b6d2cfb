# SPDX-License-Identifier: Apache-2.0
"""Common part of all controllers that learn a drive: checks before a start, and remedies for a diverging loop."""

import math
from abc import abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.analysis import feedback
from lathe_machine.control.bounded import Takeover
from lathe_machine.stages.common.obedience import Obedience, Obedient
from lathe_machine.stages.drive.drive import BoundedParameters, Drive
from lathe_machine.stages.tool.form import FormParameters
from lathe_rc.analysis.cycle_factors import (
    DriveMargin,
    Response,
    drive_margin,
    poles_in_waves,
    smallest_errors,
    supremum,
)
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.analysis.resonance_grid import poles_of
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import (
    NonNegative,
    ObedientParameters,
    Positive,
    RestartParameters,
    Value,
    parameter,
    remapped,
)
from lathe_rc.cell.stage import Stage, WiredCell
from lathe_rc.errors import DivergedError, InputError
from lathe_rc.extensions import code_of_others

_SAFE = 0.98  # largest factor of a cycle after a remedy
_BANDS = np.geomspace(60_000.0, 500.0, 32)  # [rad/s] candidate band edges of a flat Q
# Start of the stop band relative to the band edge, and ripple: the flattest first. A longer kernel may not fit into
# the memory, which holds fewer points per second at lower spindle speeds.
_SHAPES = ((2.0, 1e-6), (3.0, 1e-6), (2.0, 1e-4), (3.0, 1e-4), (2.0, 1e-3), (2.0, 1e-2))


class LawParameters(ObedientParameters, BoundedParameters, RestartParameters):
    """Parameters common to all laws."""

    feedback_delay: Annotated[int, Ge(1), Le(2**24)] = parameter(
        2048, "samples from an error to when it is visible; at least a block, at most what the cycle leaves", "sample"
    )
    allow_unstable: bool = parameter(default=False, doc="start although the factor of a cycle is not below 1")
    stop_ratio: NonNegative = parameter(
        2.0,
        "a revolution whose RMS error is more than so many times that of the form, or of the first revolution, ends "
        "the run; 0: none does",
    )
    retract_position: float = parameter(0.0, "command when retracted", "m")
    retract_time: Positive = parameter(
        1.0, "longest takeover: a command that is farther away begins where the way takes so long", "s"
    )


class Learner(Obedient):
    """Controller that learns a drive."""

    parameters: LawParameters
    learns = True
    factor: ClassVar[str] = "sup|factor of a cycle|"  #: what `worst` tells, in words
    remedy: ClassVar[str] = "change the law"  #: for a loop that diverges where none of its `cures` helps, in words

    @property
    def adjustable(self) -> Sequence[str]:
        """Return the parameters that decide whether learning converges, all float, without models of the drive."""
        common = LawParameters.model_fields.keys() | FormParameters.model_fields.keys()
        own = [row for name, row in type(self.parameters).rows().items() if name not in common]
        return [row.name for row in own if row.type is float and not row.is_list and not row.drive]

    @abstractmethod
    def factors(self, drive: Response, waves: Array, speed: float) -> Complex | None:
        """Return the factors of the error by a cycle; learning converges if the magnitude of each is below 1.

        Args:
            drive: response of the drive's position to its command.
            waves: waves per revolution, shape (n,).
            speed: speed of the spindle [rad/s].

        Returns:
            Factors of shape (k, n); None if the controller does not provide them.
        """

    def characteristic(self, drive: Response, frequency: Array, speed: float) -> tuple[Complex, Complex] | None:
        """Return D and F of the characteristic function of a feedback loop; see `lathe_machine.analysis.feedback`.

        Args:
            drive: response of the drive's position to its command.
            frequency: frequencies up to the Nyquist frequency [rad/s], shape (n,).
            speed: speed of the spindle [rad/s].

        Returns:
            Both of shape (n,); None if the controller provides `factors` instead, or nothing.
        """
        return None

    @abstractmethod
    def highest_waves(self, speed: float) -> float:
        """Return the highest waves per revolution of the factors, at ``speed`` [rad/s]."""

    def worst(self, drive: Response, speed: float) -> tuple[float, float] | None:
        """Return the largest magnitude of `factors`, and the waves per revolution where it occurs."""
        if (highest := self._highest(drive, speed)) is None:
            return None
        if isinstance(drive, MeasuredDrive):
            waves = drive.waves(highest, speed)
            size = np.abs(self._known(drive, waves, speed)).max(axis=0)
            worst = int(np.argmax(np.where(np.isnan(size), np.inf, size)))
            return float(size[worst]), float(waves[worst])
        poles = poles_in_waves(drive, highest, speed, self.shared.step)
        return supremum(lambda waves: np.abs(self._known(drive, waves, speed)).max(axis=0), highest, poles)

    def drive_margin(self, drive: Response, speed: float) -> DriveMargin | None:
        """Return the smallest error of the drive's response with which the loop diverges; None if unknown.

        Of a measured drive, the measured points count.
        """
        measured = drive if isinstance(drive, MeasuredDrive) else None
        if (highest := self._highest(drive, speed)) is None:
            return self._feedback_margin(drive, speed, measured)
        points = measured.waves(highest, speed) if measured else None
        poles = poles_in_waves(drive, highest, speed, self.shared.step)
        return drive_margin(partial(self.scaled_factors, drive, speed), highest, speed, points, poles)

    def smallest_errors(self, drive: Response, waves: Array, speed: float) -> Array:
        """Return the smallest errors of the drive at some waves per revolution above 0, shape (n,).

        The least over all waves is the `drive_margin`, which must be known.
        """
        if self._highest(drive, speed) is not None:
            return smallest_errors(partial(self.scaled_factors, drive, speed), waves)
        parts = self.characteristic(drive, waves * speed, speed)
        assert parts is not None, "the margin is known"
        return feedback.smallest_errors(*parts)

    def _feedback_margin(self, drive: Response, speed: float, measured: MeasuredDrive | None) -> DriveMargin | None:
        step, points = self.shared.step, np.zeros(0)

        def characteristic(frequency: Array) -> tuple[Complex, Complex]:
            found = self.characteristic(drive, frequency, speed)
            assert found is not None, "as before"
            return found

        with code_of_others(f"{self.name}: characteristic"):
            if self.characteristic(drive, points, speed) is None:
                return None
            if measured:
                points = measured.waves(np.pi / (step * speed), speed) * speed
            return feedback.feedback_margin(characteristic, speed, step, points, poles_of(drive))

    def scaled_factors(self, drive: Response, speed: float, waves: Array, scales: Sequence[float]) -> Sequence[Complex]:
        """Return the `factors` for the drive scaled by each of some numbers."""
        known: dict[bytes, Complex] = {}  # responses, which take the most time

        def once(frequency: Array) -> Complex:
            if (key := frequency.tobytes()) not in known:
                known[key] = drive(frequency)
            return known[key]

        return [
            self._known(lambda frequency, scale=scale: np.asarray(scale * once(frequency)), waves, speed)  # type: ignore[misc]
            for scale in scales
        ]

    def _highest(self, drive: Response, speed: float) -> float | None:
        if self.factors(drive, np.zeros(1), speed) is None:
            return None
        with code_of_others(f"{self.name}: highest_waves"):
            highest = float(self.highest_waves(speed))
        if not 0.0 < highest < np.inf:
            raise InputError(f"{self.name}: highest_waves gives {highest:g} at {speed:.4g} rad/s; allowed: above 0")
        return highest

    def _known(self, drive: Response, waves: Array, speed: float) -> Complex:
        factors = self.factors(drive, waves, speed)
        assert factors is not None, "checked by _highest"
        return factors

    def checked_speeds(self, low: float, high: float) -> Collection[float]:
        """Return the speeds [rad/s] at which `worst` is evaluated, for a spindle between two speeds."""
        return {low, (low + high) / 2, high}

    def cures(self, lag: float) -> Iterable[Iterable[Mapping[str, Value]]]:
        """Return parameters that may make a diverging loop converge, the gentlest of each kind first.

        Args:
            lag: lag of the drive at low frequencies [s].
        """
        return ()

    def settings(self) -> str:
        """Return the parameters that decide whether learning converges, in words."""
        return "its parameters"

    def encoder_warnings(self, low: float, high: float, counts: int, edge_clock: float = 0.0) -> list[str]:
        """Return causes of an avoidable form error, with remedies, one line each; none of them is an error.

        Args:
            low: lowest speed of the spindle [rad/s].
            high: highest speed of the spindle [rad/s].
            counts: encoder counts per revolution; 0 for an ideal encoder.
            edge_clock: resolution of the time of the encoder's last edge [s]; 0: it is not known.
        """
        return []

    def largest_delay(self, speed: float, acceleration: float, count: float, speed_window: float) -> int | None:
        """Return the longest feedback delay [sample] that the cycle allows.

        Args:
            speed: largest speed of the spindle [rad/s].
            acceleration: largest acceleration of the spindle [rad/s²].
            count: angle of one encoder count [rad], the largest lag of the measured angle; 0 for an ideal encoder.
            speed_window: averaging time of the encoder's speed [s]; one more count in it increases the lead.

        Returns:
            None if the controller does not provide it.
        """
        return None

    # ---- checks before a start ----------------------------------------------------------------------

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check that the feedback is in time for the cycle and that learning converges."""
        super().check_cell(cell, cures=cures)
        low, high = cell.speed_range
        self.check_delay(cell)
        self._check_convergence(cell, cures=cures)
        encoder = cell.master.parameters
        cell.warnings += self.encoder_warnings(low, high, encoder.counts_per_revolution, encoder.edge_resolution)

    def learned(self, stages: Iterable[Stage]) -> list[tuple[Response, Drive]]:
        """Return the commanded drives and their responses: that of the model, and those of further states."""
        commands = {remapped(self.shared, output.topic) for output in self.outputs}
        found: list[tuple[Response, Drive]] = []
        for drive in stages:
            if not isinstance(drive, Drive):
                continue
            for topic, model in drive.responses().items():
                if remapped(drive.shared, topic) in commands and any(port.topic == topic for port in drive.inputs):
                    found.append((model, drive))
                    found += [(state, drive) for state in drive.states().get(topic, ())]
        return found

    def checked_loop(self, cell: WiredCell) -> "CheckedLoop":
        """Return the controller with the drives that it commands, at the speeds that the checks evaluate."""
        responses = [response for response, _ in self.learned(cell.stages.values())]
        return CheckedLoop(self, responses, self.checked_speeds(*cell.speed_range))

    def allowed_delay(self, cell: WiredCell) -> int | None:
        """Return the longest feedback delay [sample] that the cycle allows in a cell; None if unknown."""
        encoder = cell.master.parameters
        count = 2 * np.pi / encoder.counts_per_revolution if encoder.counts_per_revolution else 0.0
        acceleration = cell.master.largest_acceleration()
        return self.largest_delay(cell.speed_range[1], acceleration, count, encoder.speed_window * encoder.step)

    def check_delay(self, cell: WiredCell) -> None:
        """Check that the feedback delay is not longer than the cycle allows.

        Raises:
            InputError: it is.
        """
        largest, delay = self.allowed_delay(cell), self.parameters.feedback_delay
        if largest is None:
            cell.unchecked.append(f"{self.name}: {self.kind} tells no longest feedback_delay")
        elif delay > largest:
            least = self.shared.block_size
            allowed = f"{least} up to {largest}"
            if largest < least:
                allowed = f"{largest} or less, with a block_size no longer than that"
            if largest < 1:
                allowed = "a longer cycle, a shorter lead, or a spindle that turns slower"
            raise InputError(
                f"{self.name}.feedback_delay = {delay} samples: at {cell.speed_range[1]:.4g} rad/s the cycle leaves "
                f"{max(largest, 0)}; allowed: {allowed}"
            )

    def _check_convergence(self, cell: WiredCell, *, cures: bool) -> None:
        command = remapped(self.shared, self.outputs[0].topic)
        # A member without samples of its own, such as a recorder, is no drive.
        unknown = [name for name in cell.unknown if name in cell.reader_names(command) and cell.unknown[name].dense]
        for name in unknown:
            cell.leave_open(f"whether {self.name} converges with {name}", name)
        learned, untold, loop = self.learned(cell.stages.values()), list[str](), self.checked_loop(cell)
        speeds = loop.speeds
        cell.loops.setdefault(self.name, []).append(loop)
        for response, drive in learned:
            self._check_reach(drive)
            name = f"{drive.name} {getattr(response, 'state', '')}".rstrip()
            told = [(worst, speed) for speed in dict.fromkeys(speeds) if (worst := self.worst(response, speed))]
            if broken := next(((worst, speed) for worst, speed in told if math.isnan(worst[0])), None):
                (_, waves), speed = broken
                raise InputError(
                    f"{self.name}: {self.factor} with {name} is not a number at {waves:.4g} waves and "
                    f"{speed:.4g} rad/s; allowed: finite numbers; see contraction of the law and response of the drive"
                )
            if told:
                (largest, waves), speed = max(told)
                cell.factors[self.name] = max(largest, cell.factors.get(self.name, 0.0))
                if largest >= 1.0 and not self.parameters.allow_unstable:
                    where = f"{waves * speed:.5g} rad/s ({waves:.4g} waves at {speed:.4g} rad/s)"
                    remedy = " or ".join(loop.cures() if cures else []) or self.remedy
                    raise InputError(
                        f"{self.name}: learning diverges with {name}: {self.factor} = {largest:.4g} at {where} "
                        f"with {self.settings()}; allowed: below 1 ({remedy}; or set allow_unstable)"
                    )
            elif margins := [found for speed in speeds if (found := self.drive_margin(response, speed))]:
                least = min(margins)
                if least.error == 0.0 and not self.parameters.allow_unstable:
                    raise InputError(
                        f"{self.name}: the loop with {name} is unstable at {least.speed:.4g} rad/s; allowed: a stable "
                        f"one ({self.remedy}; or set allow_unstable)"
                    )
            else:
                untold.append(f"{self.name}: {self.kind} tells no factor of a cycle: nobody knows if it converges")
        if not learned and not unknown:
            untold.append(f"{self.name}: no drive tells its response to {command}: nobody knows if it converges")
        if untold and not (self.parameters.stop_ratio or self.parameters.allow_unstable):
            raise InputError(
                f"{untold[0]}; allowed: {self.name}.stop_ratio above 0 (2: twice the error of the first cycle ends "
                "the run), or allow_unstable"
            )
        cell.unchecked += untold

    def _check_reach(self, drive: Drive) -> None:
        """Check that the bounds allow a takeover from every position of a drive."""
        parameters = self.parameters
        reach = parameters.bounds().reach(parameters.retract_time)
        for limits in drive.limits().values() if parameters.reaction_delay else ():
            needed = limits.stroke + max(limits.stroke, abs(parameters.retract_position))
            if reach < needed:
                raise InputError(
                    f"{self.name}.retract_time = {parameters.retract_time:g} s: the bounds allow a way of {reach:.3g} "
                    f"m in that, and the stroke of {drive.name} needs {needed:.3g} m; allowed: a longer retract_time, "
                    "or wider bounds"
                )

    # ---- obedience ----------------------------------------------------------------------------------

    def _make_obedience(self, settled: int) -> Obedience | None:
        """Build the obedience to the supervisor, if any; learning ignores ``settled`` samples after a takeover."""
        parameters = self.parameters
        if not parameters.reaction_delay:
            return None
        bounds = parameters.bounds()
        reach = bounds.reach(parameters.retract_time)
        takeover = Takeover(bounds, parameters.retract_position, parameters.step, reach=reach)
        return Obedience(self.name, takeover, settled=settled)

    def _diverged(self, index: int, rms: float, first: float) -> DivergedError:
        """Return the error of a run whose RMS error in a cycle grows beyond ``first`` [m]."""
        ratio = rms / first if first > 0.0 else np.inf
        return DivergedError(
            f"sample {index}: the error grows: {rms * 1e6:.4g} µm RMS in a cycle, {ratio:.3g} times {first * 1e6:.4g} "
            f"µm; allowed: stop_ratio = {self.parameters.stop_ratio:g} (a smaller gain, or another law)"
        )


def lag(response: Response) -> float:
    """Return the lag of a drive at low frequencies [s]."""
    value = response(np.ones(1))[0]  # at 1 rad/s
    return float(-np.angle(value if value.real >= 0.0 else -value))


class CheckedLoop(NamedTuple):
    """Learning controller with the drives that it commands.

    Attributes:
        stage: stage of the controller.
        responses: responses of the drives.
        speeds: speeds at which the loop is evaluated [rad/s].
    """

    stage: Learner
    responses: Collection[Response]
    speeds: Collection[float]

    def factor(self, values: Mapping[str, Value]) -> float:
        """Return the largest factor of a cycle with some parameters changed; inf if invalid or not provided."""
        try:
            stage = type(self.stage)(self.stage.name, self.stage.parameters.model_copy(update=dict(values)))
        except InputError:  # too large for the memory
            return np.inf
        told = [stage.worst(response, speed) for response in self.responses for speed in self.speeds]
        return max((np.inf if worst is None or np.isnan(worst[0]) else worst[0] for worst in told), default=np.inf)

    def drive_margin(self) -> DriveMargin | None:
        """Return the smallest error of a drive with which learning diverges, over all drives and speeds."""
        found = self.worst()
        return found and found[0]

    def worst(self) -> tuple[DriveMargin, Response] | None:
        """Return the drive margin and the response of the drive with which it is the least."""
        each = [(self.stage.drive_margin(drive, speed), drive) for drive in self.responses for speed in self.speeds]
        return min(((margin, drive) for margin, drive in each if margin), key=lambda pair: pair[0], default=None)

    def first(self, candidates: Iterable[Mapping[str, Value]], allowed: float = _SAFE) -> Mapping[str, Value] | None:
        """Return the first parameters with all factors within the allowed value; None if there are none."""
        return next((values for values in candidates if self.factor(values) <= allowed), None)

    def cures(self) -> list[str]:
        """Return parameter changes with which a diverging loop converges."""
        found: list[Mapping[str, Value]] = []
        for candidates in self.stage.cures(max(map(lag, self.responses))):
            cure = self.first(each for each in candidates if not any(each.keys() >= known.keys() for known in found))
            found += [cure] if cure else []
        name = self.stage.name
        return [" and ".join(f"{name}.{key} = {value:g}" for key, value in cure.items()) for cure in found]

    def flat(
        self,
        allowed: float,
        stop: float | None = None,
        ripple: float | None = None,
        others: Mapping[str, Value] = MappingProxyType({}),
    ) -> dict[str, Value] | None:
        """Return the widest flat Q, an FIR low-pass, of the first shape with which the loop converges; None if none.

        Args:
            allowed: largest permitted factor of a cycle.
            stop: start of the stop band [rad/s]; None: free.
            ripple: ripple of the filter; None: free.
            others: further parameter changes.
        """
        for ratio, each in dict.fromkeys((ratio, ripple or own) for ratio, own in _SHAPES):
            bands = _BANDS if stop is None else _BANDS[stop > _BANDS]
            made = ({"q_pass": float(band), "q_stop": stop or float(ratio * band)} for band in bands)
            shape = {**others, "q_filter": "fir", "q_ripple": each}
            if found := self.first(({**shape, **band} for band in made), allowed):
                return dict(found)
        return None
