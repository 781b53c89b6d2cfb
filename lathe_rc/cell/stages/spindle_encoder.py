# SPDX-License-Identifier: Apache-2.0
"""Spindle and encoder: where time, angle and the run itself begin and end."""

from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Le

from lathe_rc.cell import messages
from lathe_rc.cell.native import Step
from lathe_rc.cell.parameters import about, parameter
from lathe_rc.cell.stage import DONE, Fields, Joint, Output, Reached, Stage, Trigger
from lathe_rc.cell.stages.speed_law import SpeedLawParameters
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.encoder import Encoder, EncoderTable, encode


class SpindleEncoderParameters(SpeedLawParameters):
    """Speed law, encoder, and, for the time master of a cell, length and pace of the run."""

    counts_per_revolution: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        0, "encoder counts per revolution after quadrature; 0: an ideal encoder"
    )
    speed_window: Annotated[int, Ge(1), Le(65536)] = parameter(
        64,
        "the measured speed is the angle's difference over so many samples; not used by an ideal encoder",
        "sample",
    )
    revolutions: Annotated[float, Ge(0)] = parameter(0.0, "length of the run; 0: until stopped", "rev")
    speed_factor: Annotated[float, Ge(0)] = parameter(
        1.0, "pace of the run against real time; 0: as fast as the members follow", "1"
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
    members: list[str] = parameter([], "nodes that must be ready before block 0; empty: start alone")
    processes: list[str] = parameter(
        [], "nodes that share a process, as 'coarse+tool', for harness and launch; those not named have one each"
    )


@kernel
def step(memory: EncoderTable, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """See `lathe_rc.cell.stage`."""
    angle, speed, index_pulse, angle_true, speed_true = outputs
    encode(memory, first, angle, speed, index_pulse, angle_true, speed_true)
    return angle.size, DONE


class SpindleEncoder(Stage):
    """See `lathe_rc.signals.speed` and `lathe_rc.signals.encoder`.

    Attributes:
        parameters: its table.
        law: the speed law.
        samples: length of the run [sample]; None: endless.
    """

    kind = "spindle_encoder"
    Parameters = SpindleEncoderParameters
    step: ClassVar[Step | None] = staticmethod(step)

    def __init__(self, name: str, parameters: SpindleEncoderParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.law = parameters.speed_law(name)
        self.samples: int | None = None
        if parameters.revolutions:
            with about(name, f"revolutions = {parameters.revolutions:g}"):
                self.samples = self.law.samples_until(2 * np.pi * parameters.revolutions, parameters.step)
        self._check_end()
        self._triggers = [self._by_sample(trigger) for trigger in self._triggers]
        self._encoder = Encoder(self.law, parameters.step, parameters.counts_per_revolution, parameters.speed_window)
        self.declare(outputs=[Output("encoder", messages.ENCODER, Joint("angle", "speed"))])

    def _check_end(self) -> None:
        """A law of others is known up to the end of its tachogram."""
        parameters, seconds = self.parameters, (self.samples or 0) * self.shared.step
        if parameters.deviation_law and seconds > parameters.deviation_law_end:
            raise InputError(
                f"{self.name}.deviation_law_end = {parameters.deviation_law_end:g} s: the run takes {seconds:.5g} s; "
                "allowed: not before its end"
            )

    def _by_sample(self, trigger: Trigger) -> Trigger:
        """The same trigger; who makes the angle knows when it comes."""
        if trigger.kind != "revolution":
            return trigger
        with about(self.name, f"{trigger.parameter} = {trigger.text!r}"):
            sample = self.law.samples_until(2.0 * np.pi * trigger.value, self.parameters.step)
        return replace(trigger, kind="sample", value=float(sample))

    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest spindle speed in the run [rad/s]."""
        return self.law.speed_range(np.inf if self.samples is None else self.samples * self.shared.step)

    @property
    def memory(self) -> tuple[Any, ...]:
        """See `Stage`."""
        return self._encoder.table
