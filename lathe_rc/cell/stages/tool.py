# SPDX-License-Identifier: Apache-2.0
"""The tool against the part: desired form, displacement, form error."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from annotated_types import MinLen

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.stage import Input, Joint, Output, Sparse, Stage
from lathe_rc.cell.stages.form import Form, FormParameters
from lathe_rc.errors import InputError


class ToolParameters(FormParameters):
    """The drives that move the tool, and the desired form of the part unless a profile node publishes it."""

    reference: Literal["own", "topic"] = parameter(
        "own", "own: the form below; topic: what a profile node publishes, which others can read before the tool"
    )
    drives: Annotated[list[str], MinLen(1)] = parameter(
        ["coarse"], "what moves the tool against the part, by the first word of its state topic; motions add up"
    )


class Tool(Stage):
    """Sums the motions (paper 001, Fig. 1a) and compares with the desired form.

    Attributes:
        parameters: its table.
        form: of the part; None if a profile node has it.
    """

    kind = "tool"
    Parameters = ToolParameters

    def __init__(self, name: str, parameters: ToolParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.form = Form(name, parameters) if parameters.reference == "own" else None
        if len(set(parameters.drives)) < len(parameters.drives):
            raise InputError(f"{name}.drives = {parameters.drives}; allowed: each drive once")
        what = Input("encoder", messages.ENCODER, ("angle", "angle_true"))
        if self.form is None:
            what = Input("reference", messages.REFERENCE, ("reference", "expected", "height"))
        states = [
            Input(f"{drive}/state", messages.STATE, ("position", "measured_position")) for drive in parameters.drives
        ]
        self.declare(inputs=[what, *states], outputs=[Output("tool", messages.TOOL, Joint("displacement"))])

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """δ = Xd - X at the true spindle angle (paper 000, Fig. 1).

        What a controller can know differs: the desired form at the measured angle, less the measured motions.
        """
        (what, *states), (tool,) = inputs, outputs
        known, displacement = tool["measured_error"], tool["displacement"]
        if self.form is None:
            tool["reference"][:], known[:], tool["height"][:] = what["reference"], what["expected"], what["height"]
        else:
            self.form.block(what, tool["reference"], known, tool["height"])
        displacement[:] = states[0]["position"]
        known -= states[0]["measured_position"]
        for state in states[1:]:
            displacement += state["position"]
            known -= state["measured_position"]
        np.subtract(tool["reference"], displacement, out=tool["error"])
        return []
