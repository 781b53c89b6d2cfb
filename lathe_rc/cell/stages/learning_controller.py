# SPDX-License-Identifier: Apache-2.0
"""Self-learning controller of one channel."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_rc.analysis.learning import LearningLoop, Response
from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.cell.stage import Input, Output, Sparse, Stage
from lathe_rc.control.repetitive import (
    LeadLaw,
    RepetitiveController,
    exponential_q,
    largest_feedback_delay,
)
from lathe_rc.plants.linear import discretise, second_order

_LEAD_LAWS = {"variable": LeadLaw.VARIABLE, "constant_angle": LeadLaw.CONSTANT_ANGLE}


class LearningControllerParameters(NodeParameters):
    """The angle-domain P-integrator, and the drive model that its stability margin is computed from."""

    lead_time: Annotated[float, Ge(0), Le(1)] = parameter(1.425e-3, "T0: the drive's delay that the lead answers", "s")
    lead_law: Literal["variable", "constant_angle"] = parameter(
        "variable", "variable: lead angle T0·Ω (paper 000, eq. 20); constant_angle: T0·Ω0"
    )
    q_time: Annotated[float, Ge(0), Le(1)] = parameter(
        67.0e-6,
        "time constant of the two-sided exponential Q at nominal speed; its width is fixed in angle",
        "s",
    )
    learning_gain: Annotated[float, Gt(0), Le(2)] = parameter(1.0, "γ; 1 in the papers")
    points_per_revolution: Annotated[int, Ge(64), Le(65536)] = parameter(1024, "points of the memory per revolution")
    cycle_revolutions: Annotated[int, Ge(1), Le(1024)] = parameter(1, "cycle angle θ", "rev")
    feedback_delay: Annotated[int, Ge(1), Le(2**24)] = parameter(
        2048,
        "samples from an error to when it is visible; at least a block, at most what the cycle leaves",
        "sample",
    )
    allow_unstable: bool = parameter(default=False, doc="start although sup|Q - Z| is not below 1")
    model_natural_frequency: Annotated[float, Gt(0)] = parameter(1038.0, "drive model: ωn", "rad/s")
    model_damping: Annotated[float, Gt(0)] = parameter(0.804, "drive model: ζ", "1")
    model_delay: Annotated[float, Ge(0), Le(0.1)] = parameter(0.36e-3, "drive model: delay", "s")


class LearningController(Stage):
    """See `lathe_rc.control.repetitive`."""

    kind = "learning_controller"
    Parameters = LearningControllerParameters
    actions = ("freeze", "learn", "clear")

    def __init__(self, name: str, parameters: LearningControllerParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        grid_angle = 2 * np.pi / parameters.points_per_revolution
        self._q = exponential_q(parameters.q_time * parameters.nominal_speed, grid_angle)
        self._controller = RepetitiveController(
            grid=parameters.points_per_revolution,
            revolutions=parameters.cycle_revolutions,
            q=self._q,
            gain=parameters.learning_gain,
            lead_law=_LEAD_LAWS[parameters.lead_law],
            lead_time=parameters.lead_time,
            nominal=parameters.nominal_speed,
            delay=parameters.feedback_delay,
        )
        a, b = second_order(parameters.model_natural_frequency, parameters.model_damping)
        model = discretise(a, b, parameters.model_delay, parameters.step, "foh")
        self._model_loop = self.loop(model.response)
        # Tabulated before the start: a margin costs as much as a whole cycle of samples.
        self._speeds = parameters.nominal_speed * np.linspace(0.5, 1.5, 41)
        self._suprema = np.array([self._model_loop.supremum(speed) for speed in self._speeds])
        self._cycle_start = parameters.feedback_delay  # where the first error becomes visible
        delay = parameters.feedback_delay
        self.declare(
            inputs=[
                Input("encoder", messages.ENCODER, ("angle", "speed")),
                Input("encoder", messages.ENCODER, ("angle",), delay),
                Input("tool", messages.TOOL, ("measured_error",), delay),
            ],
            outputs=[Output("coarse/command", messages.COMMAND)],
        )
        self.sparse_topics["coarse/learning"] = messages.LEARNING

    def loop(self, drive: Response) -> LearningLoop:
        """The learning loop around a drive with the given response."""
        parameters = self.parameters
        return LearningLoop(
            drive=drive,
            q=self._q,
            grid=parameters.points_per_revolution,
            gain=parameters.learning_gain,
            lead_time=parameters.lead_time,
            nominal=parameters.nominal_speed,
            variable_lead=parameters.lead_law == "variable",
            step=parameters.step,
        )

    def largest_delay(self, highest_speed: float, count: float, speed_window: float) -> int:
        """Longest feedback delay [sample] that the cycle leaves.

        Args:
            highest_speed: of the spindle [rad/s].
            count: angle of one encoder count [rad]: the measured angle is late by up to that; 0 if ideal.
            speed_window: time over which the encoder measures its speed [s]: one count more in it is a larger lead.
        """
        parameters = self.parameters
        variable = parameters.lead_law == "variable"
        fastest = highest_speed + count / speed_window if variable else parameters.nominal_speed
        return largest_feedback_delay(
            grid=parameters.points_per_revolution,
            revolutions=parameters.cycle_revolutions,
            lead=parameters.lead_time * fastest,
            speed=highest_speed,
            late=count,
            step=parameters.step,
        )

    def perform(self, action: str) -> None:
        """See `Stage`."""
        if action == "clear":
            self._controller.clear()
        else:
            self._controller.learning = action == "learn"

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        (encoder, past, tool), (command,) = inputs, outputs
        cycles = self._controller.block(
            first,
            angle=encoder["angle"],
            speed=encoder["speed"],
            past_angle=past["angle"],
            error=tool["measured_error"],
            command=command["position"],
        )
        sparse = []
        for cycle in cycles:
            values = {
                "cycle": cycle.number,
                "rms_error": cycle.rms,
                "max_error": cycle.largest,
                "contraction": cycle.contraction,
                "stability_margin": self._margin(cycle.sample_index),
                "learning": cycle.learning,
            }
            sparse.append(Sparse("coarse/learning", messages.LEARNING, cycle.sample_index, values))
        return sparse

    def _margin(self, sample: int) -> float:
        """1 - sup|Q - Z| at the mean speed of the cycle that ends at ``sample``."""
        start, self._cycle_start = self._cycle_start, sample
        speed = 2 * np.pi * self.parameters.cycle_revolutions / ((sample - start) * self.shared.step)
        if not self._speeds[0] <= speed <= self._speeds[-1]:
            return 1.0 - self._model_loop.supremum(speed)
        return 1.0 - float(np.interp(speed, self._speeds, self._suprema))
