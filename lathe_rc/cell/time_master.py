# SPDX-License-Identifier: Apache-2.0
"""Source of the cell's time and angle: an emulated spindle, a real encoder, or a recorded one."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from lathe_rc.cell.events import Trigger
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Value, about, parameter
from lathe_rc.cell.stage import Stage, WiredCell
from lathe_rc.errors import InputError
from lathe_rc.signals.speed import SpeedLaw

START_FROM = "start_from"  #: parameter of the time master that names a checkpoint
_LEAST_SAMPLES = 4  # per revolution
_LEAST_CLOCK = 1e-12  # [s]


class TimeMasterParameters(NodeParameters):
    """Measured speed, and length and pace of the run."""

    counts_per_revolution: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        0, "encoder counts per revolution after quadrature; 0: an ideal encoder"
    )
    edge_clock: Annotated[float, Ge(0), Le(1)] = parameter(
        0.0,
        "resolution of the time stamp of the encoder's last edge, for the angle between two counts; 0: none; not "
        "used by an ideal encoder",
        "s",
    )
    speed_window: Annotated[int, Ge(1), Le(65536)] = parameter(
        64, "the measured speed is the angle's difference over so many samples; not used by an ideal encoder", "sample"
    )
    revolutions: NonNegative = parameter(0.0, "length of the run; 0: until stopped", "rev")
    start_from: str = parameter("", "checkpoint from which the run goes on; empty: it starts at sample 0", path=True)
    speed_factor: NonNegative = parameter(
        1.0, "pace of the run against real time; 0: as fast as the members follow", "1"
    )
    strict_pace: bool = parameter(
        default=False, doc="end the run, with exit code 4, when the members are too slow for speed_factor"
    )
    stall_reaction: Literal["wait", "safe"] = parameter(
        "wait", "what a member leads to that is silent; one whose process has died leads to the safe state"
    )
    stall_time: Annotated[float, Ge(0), Le(3600)] = parameter(
        0.1, "wall time of silence after which the safe state is declared, if that is the reaction", "s"
    )
    safe_time: Annotated[float, Ge(0), Le(10)] = parameter(0.2, "how long a run goes on in the safe state", "s")
    restart_time: Annotated[float, Ge(0), Le(3600)] = parameter(
        30.0, "wall time in which a member that can be restarted has to be back", "s"
    )
    simulation_services: Literal["", "playing", "paused"] = parameter(
        "", "offer services of simulation_interfaces, with a run that begins playing or paused; empty: none"
    )
    members: list[str] = parameter([], "nodes that must be ready before block 0; empty: start alone")
    processes: list[str] = parameter(
        [], "nodes that share a process, as 'coarse+tool', for harness and launch; those not named have one each"
    )

    def model_post_init(self, context: Any, /) -> None:
        """Reject a clock that no time of a run resolves."""
        super().model_post_init(context)
        if 0.0 < self.edge_clock < _LEAST_CLOCK:
            raise InputError(f"edge_clock = {self.edge_clock:g} s; allowed: 0, or from {_LEAST_CLOCK:g} s up to 1 s")

    @property
    def edge_resolution(self) -> float:
        """Resolution of the time of the encoder's last edge [s]; 0: it is not known."""
        return self.edge_clock

    def known(self) -> Mapping[str, Value]:
        """Counts of the encoder and resolution of their edges' times, for laws that filter its angle."""
        return {"encoder_counts": self.counts_per_revolution, "encoder_edge_clock": self.edge_resolution}

    def shown(self) -> Mapping[str, Any]:
        """Length of the run."""
        return {"revolutions": self.revolutions}


class TimeMaster(Stage):
    """Stage that provides time and angle to all others, and reads no other stage.

    Attributes:
        samples: length of the run [sample]; None: endless, or not known yet.
        live: whether readings arrive in real time while the cell runs, which excludes offline runs.
        law: speed law of the spindle; None: not known in advance.
    """

    parameters: TimeMasterParameters
    live = False
    law: SpeedLaw | None = None

    def __init__(self, name: str, parameters: TimeMasterParameters) -> None:
        super().__init__(name, parameters)
        self.samples: int | None = None

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Reject a spindle that turns back, or too fast for the sampling rate."""
        super().check_cell(cell, cures=cures)
        low, high = cell.speed_range
        if low <= 0.0:
            raise InputError(
                f"{self.name}.nominal_rpm and its deviations: speed falls to {low:.4g} rad/s; allowed: above 0"
            )
        if (samples := 2.0 * np.pi / (high * self.shared.step)) < _LEAST_SAMPLES:
            raise InputError(
                f"{self.name}.nominal_rpm and its deviations: a revolution takes {samples:.3g} samples at "
                f"{high:.4g} rad/s; allowed: {_LEAST_SAMPLES} or more (turn slower, or raise sample_rate)"
            )

    @abstractmethod
    def sample_at(self, angle: float) -> int:
        """Return the first sample at which the true angle has reached ``angle`` [rad].

        Raises:
            InputError: the angle is never reached, or this is not known.
        """

    @abstractmethod
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest spindle speed in the run [rad/s]."""

    @abstractmethod
    def largest_acceleration(self) -> float:
        """Upper bound of the magnitude of dΩ/dt in the run [rad/s²]."""

    @property
    def expected_samples(self) -> int | None:
        """Return the expected length of the run [sample], at nominal speed if not known yet; None if endless."""
        if self.samples is not None or not self.parameters.revolutions:
            return self.samples
        return round(self.parameters.revolutions * 2.0 * np.pi / self.shared.nominal_speed / self.shared.step)

    def place_triggers(self) -> None:
        """Convert events by revolutions into events by sample, from the angle that this stage determines."""
        self._triggers = [self._by_sample(trigger) for trigger in self._triggers]

    def _by_sample(self, trigger: Trigger) -> Trigger:
        if trigger.kind != "revolution":
            return trigger
        with about(self.name, f"{trigger.parameter} = {trigger.text!r}"):
            sample = self.sample_at(2.0 * np.pi * trigger.value)
        return replace(trigger, kind="sample", value=float(sample))
