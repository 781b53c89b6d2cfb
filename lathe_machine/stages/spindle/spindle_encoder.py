# SPDX-License-Identifier: Apache-2.0
"""Spindle and encoder: source of time and angle, and of start and end of a run."""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.signals.encoder import Encoder, EncoderTable, encode
from lathe_machine.signals.encoder_errors import EncoderErrors
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.spindle.speed_law import SpeedLawParameters
from lathe_rc import messages
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.parameters import about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.cell.time_master import TimeMaster, TimeMasterParameters
from lathe_rc.compiled.step import Step
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

_SHORT = 0.01  # largest fraction of a run not covered by its tachogram


class SpindleEncoderParameters(TimeMasterParameters, SpeedLawParameters):
    """Speed law, encoder, and, for the time master of a cell, length and pace of the run."""

    reads_per_sample: Annotated[int, Ge(1), Le(65536)] = parameter(
        1, "readings of the counter per sample; several give the time of an edge, as edge_clock; not with it"
    )
    disc_eccentricity: Annotated[float, Ge(0), Le(0.5)] = parameter(
        0.0, "encoder: eccentricity of its disc over the radius of its track; error once a revolution; 0: none", "rad"
    )
    disc_phase: float = parameter(0.0, "encoder: phase of that error at the angle 0", "rad")
    signal_periods: Annotated[int, Ge(1), Le(10_000_000)] = parameter(
        1024, "encoder: signal periods a revolution, for the errors within one"
    )
    signal_cosine_offset: float = parameter(0.0, "encoder: offset of the cosine signal, as a part of its amplitude")
    signal_sine_offset: float = parameter(0.0, "encoder: the same of the sine signal")
    signal_mismatch: float = parameter(0.0, "encoder: by how much the sine is larger than the cosine, as a part of it")
    signal_skew: float = parameter(0.0, "encoder: what the two signals lack of a right angle", "rad")

    def model_post_init(self, context: Any, /) -> None:
        """Reject two sources of the edges' times."""
        super().model_post_init(context)
        if self.edge_clock and self.reads_per_sample > 1:
            raise InputError(
                f"reads_per_sample = {self.reads_per_sample} with edge_clock = {self.edge_clock:g} s; allowed: one of "
                "them (1, or 0), since each gives the times of the edges"
            )

    @property
    def edge_resolution(self) -> float:
        """Resolution of the time of the encoder's last edge [s]; 0: it is not known."""
        return self.step / self.reads_per_sample if self.reads_per_sample > 1 else self.edge_clock

    def errors(self, node: str) -> EncoderErrors:
        """Return the encoder errors of a node.

        Raises:
            InputError: see `EncoderErrors`.
        """
        errors = made_of(EncoderErrors, self, "disc_", "signal_")
        with about(node, "signal_cosine_offset", "signal_sine_offset", "signal_mismatch", "signal_skew"):
            errors.check()
        return errors


@kernel
def step(memory: EncoderTable, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Turn the spindle through one block, and read its encoder."""
    encode(memory, first, outputs)
    return outputs[0].size, DONE


class SpindleEncoder(TimeMaster):
    """Spindle that follows a speed law, with its encoder (see `lathe_machine.signals.encoder`).

    Attributes:
        law: speed law; None if a load changes it.
    """

    kind = "spindle_encoder"
    Parameters = SpindleEncoderParameters
    parameters: SpindleEncoderParameters
    step: ClassVar[Step | None] = staticmethod(step)

    def __init__(self, name: str, parameters: SpindleEncoderParameters) -> None:
        super().__init__(name, parameters)
        # Two names: a loaded spindle does not publish its law.
        self._law = self.law = parameters.speed_law(name)
        if parameters.revolutions:
            with about(name, f"revolutions = {parameters.revolutions:g}", "nominal_rpm and its deviations"):
                end = 2 * np.pi * parameters.revolutions + self._lag()
                self.samples = self._law.samples_until(end, parameters.step)
        self._check_end()
        self.place_triggers()
        counts, window = parameters.counts_per_revolution, parameters.speed_window
        errors, clock = parameters.errors(name), parameters.edge_resolution
        self._encoder = Encoder(self._law, parameters.step, counts, window, errors, clock)
        loads = self._loads()
        outputs = [Output("encoder", messages.ENCODER, Joint("angle", "speed"))]
        self.declare(inputs=loads, outputs=outputs, tells=bool(loads))

    def _loads(self) -> Sequence[Input]:
        """Inputs with the loads of the spindle."""
        return ()

    def _lag(self) -> float:
        """Largest lag behind the speed law caused by a load [rad]."""
        return 0.0

    def _check_end(self) -> None:
        """Check that the run ends within the tachogram of a third-party speed law."""
        parameters, seconds = self.parameters, (self.samples or 0) * self.shared.step
        if parameters.deviation_law and seconds > parameters.deviation_law_end:
            raise InputError(
                f"{self.name}.deviation_law_end = {parameters.deviation_law_end:g} s: the run takes {seconds:.5g} s at "
                "the speed there; allowed: not before its end, which another speed moves (leave a margin)"
            )

    def warnings(self, seconds: float) -> list[str]:
        """Return a warning about a tachogram outside the run."""
        time, deviation, _ = self._law.tachogram
        rpm, doubt = self.parameters.nominal_rpm * (1.0 + deviation), ""
        if self.parameters.tachogram_file and time[-1] < (1.0 - _SHORT) * seconds:
            end = f"the run at {seconds:.5g} s" if np.isfinite(seconds) else "the run does not end"
            doubt = (
                f"tachogram_file ends {time[-1]:.5g} s after its first row, {end}: the spindle goes on at "
                f"{rpm[-1]:.5g} rpm"
            )
        elif self.parameters.tachogram_time and time[0] >= seconds:
            doubt = (
                f"tachogram_time begins at {time[0]:.10g} s, after the end of the run at {seconds:.5g} s: the spindle "
                f"turns at {rpm[0]:.5g} rpm throughout; times count from the start of the run"
            )
        return [f"{self.name}.{doubt}"] if doubt else []

    def sample_at(self, angle: float) -> int:
        """Return the first sample at which the speed law has reached an angle [rad]."""
        return self._law.samples_until(angle, self.parameters.step)

    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed in the run [rad/s]."""
        return self._law.speed_range(np.inf if self.samples is None else self.samples * self.shared.step)

    def largest_acceleration(self) -> float:
        """Upper bound of the magnitude of dΩ/dt in the run [rad/s²]."""
        return self._law.largest_acceleration()

    @property
    def memory(self) -> tuple[Any, ...]:
        """Current memory of the step of the spindle encoder."""
        return self._encoder.table
