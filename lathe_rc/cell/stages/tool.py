# SPDX-License-Identifier: Apache-2.0
"""The tool against the part: desired form, displacement, form error."""

from collections.abc import Sequence
from typing import Annotated, Literal

from annotated_types import Ge, Le, MinLen

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.stage import Input, Joint, Output, Sparse, Stage
from lathe_rc.cell.stages.form import Form, FormParameters
from lathe_rc.errors import InputError
from lathe_rc.plants.tool import add_drive


class ToolParameters(FormParameters):
    """The drives that move the tool, and the desired form of the part unless a profile node publishes it."""

    reference: Literal["own", "topic"] = parameter(
        "own", "own: the form below; topic: what a profile node publishes, which others can read before the tool"
    )
    drives: Annotated[list[str], MinLen(1)] = parameter(
        ["coarse"], "what moves the tool against the part, by the first word of its state topic; motions add up"
    )
    cross_slide: bool = parameter(
        default=False,
        doc="the cross slide, positive into the part, counts in the form error; no drive's sensor sees it",
    )
    deflects: bool = parameter(
        default=False, doc="the deflection by the cutting force is part of the form error; no drive's sensor sees it"
    )
    deflection_delay: Annotated[int, Ge(1), Le(2**31 - 1)] = parameter(
        64, "deflects: delay of the feedback edge from the cut, at least a block", "sample"
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
        what = [Input("reference", messages.REFERENCE, ("reference", "expected", "height"))]
        if self.form is not None:
            what = self.form.inputs
        self._drives = slice(len(what), len(what) + len(parameters.drives))
        inputs = what + [
            Input(f"{drive}/state", messages.STATE, ("position", "measured_position")) for drive in parameters.drives
        ]
        if parameters.cross_slide:
            inputs.append(Input("cross/state", messages.STATE, ("position",)))
        if parameters.deflects:
            inputs.append(Input("cut", messages.CUT, ("deflection",), parameters.deflection_delay))
        self.declare(inputs=inputs, outputs=[Output("tool", messages.TOOL, Joint("displacement"))])

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage` and `lathe_rc.plants.tool`."""
        (tool,), states = outputs, inputs[self._drives]
        reference, known = tool["reference"], tool["measured_error"]
        if self.form is None:
            what = inputs[0]
            reference[:], known[:], tool["height"][:] = what["reference"], what["expected"], what["height"]
        else:
            self.form.block(inputs, reference, known, tool["height"])
        for place, state in enumerate(states):
            add_drive(
                place == 0, reference, known, state["position"], state["measured_position"], tool["displacement"],
                known, tool["error"],
            )  # fmt: skip
        if self.parameters.cross_slide:
            tool["error"] += inputs[self._drives.stop]["position"]
        if self.parameters.deflects:
            tool["error"] -= inputs[-1]["deflection"]
        return []
