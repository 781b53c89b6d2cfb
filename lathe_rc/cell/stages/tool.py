# SPDX-License-Identifier: Apache-2.0
"""The tool against the part: desired form, displacement, form error."""

from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le, MinLen

from lathe_rc import messages
from lathe_rc.arrays import put
from lathe_rc.cell.parameters import Value, parameter
from lathe_rc.cell.stage import DONE, Fields, Input, Joint, Output, Reached, Stage
from lathe_rc.cell.stages.form import Form, FormParameters, FormTable, evaluate
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


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
    nose_radius: Annotated[float, Ge(0)] = parameter(
        0.0, "radius of its nose in the plane of the feed: the result tells the roughness along the part; 0: not", "m"
    )
    deflects: bool = parameter(
        default=False, doc="the deflection by the cutting force is part of the form error; no drive's sensor sees it"
    )
    deflection_delay: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        64,
        "deflects: delay of the feedback edge from the cut, at least a block; 0 where the cut does not read the tool",
        "sample",
    )
    tolerance: Annotated[float, Ge(0)] = parameter(
        0.0, "form error that is allowed to each side, for the verdict on a run; 0: none is given", "m"
    )

    judging = frozenset({"tolerance"})

    def known(self) -> Mapping[str, Value]:
        """See `NodeParameters`."""
        return super().known() if self.reference == "own" else {}


class Memory(NamedTuple):
    """Memory of the step.

    Attributes:
        form: of the part; without a table if a profile node has it.
        begin: number of the first input of the drives.
        drives: how many there are, with a true and a measured position each.
        cross_slide, deflects: whether these come after the drives.
    """

    form: FormTable
    begin: int
    drives: int
    cross_slide: bool
    deflects: bool


@kernel
def add_drive(
    begins: bool,  # noqa: FBT001 - kernels take their arguments by position
    reference: Samples,
    expected: Samples,
    position: Samples,
    measured: Samples,
    displacement: Samples,
    known: Samples,
    error: Samples,
) -> None:
    """Add a drive's motion; all [m] and of shape (n,). The first drive ``begins`` the sum.

    The error is Xd - X of what is true (paper 000, Fig. 1); what can be known of it is what is expected at the measured
    angle less the measured motions.
    """
    for k in range(reference.size):
        displacement[k] = position[k] if begins else displacement[k] + position[k]
        known[k] = (expected[k] if begins else known[k]) - measured[k]
        error[k] = reference[k] - displacement[k]


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """See `lathe_rc.cell.stage`."""
    reference, displacement, error, known, height = outputs
    if memory.form.heights.size:
        evaluate(memory.form, inputs, reference, known, height)
    else:
        put(reference, inputs[0])
        put(known, inputs[1])
        put(height, inputs[2])
    place = memory.begin
    for drive in range(memory.drives):
        add_drive(drive == 0, reference, known, inputs[place], inputs[place + 1], displacement, known, error)
        place += 2
    if memory.cross_slide:
        position = inputs[place]
        for k in range(error.size):
            error[k] += position[k]
        place += 1
    if memory.deflects:
        deflection = inputs[place]
        for k in range(error.size):
            error[k] -= deflection[k]
    return error.size, DONE


_ELSEWHERE = FormTable(
    np.empty(0), np.empty((0, 0, 0)), np.empty((0, 0, 0)), alike=True, slide=0, feed=0.0, start=0.0, part=0
)


class Tool(Stage):
    """Sums the motions (paper 001, Fig. 1a) and compares with the desired form.

    Attributes:
        parameters: its table.
        form: of the part; None if a profile node has it.
    """

    kind = "tool"
    Parameters = ToolParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: ToolParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.form = Form(name, parameters) if parameters.reference == "own" else None
        if len(set(parameters.drives)) < len(parameters.drives):
            raise InputError(f"{name}.drives = {parameters.drives}; allowed: each drive once")
        what = [Input("reference", messages.REFERENCE, ("reference", "expected", "height"))]
        if self.form is not None:
            what = self.form.inputs
        inputs = what + [
            Input(f"{drive}/state", messages.STATE, ("position", "measured_position")) for drive in parameters.drives
        ]
        if parameters.cross_slide:
            inputs.append(Input("cross/state", messages.STATE, ("position",)))
        if parameters.deflects:
            inputs.append(Input("cut", messages.CUT, ("deflection",), parameters.deflection_delay))
        self.declare(inputs=inputs, outputs=[Output("tool", messages.TOOL, Joint("displacement"))])

    def warnings(self, seconds: float) -> list[str]:
        """See `Stage`."""
        return self.form.doubts if self.form else []

    @property
    def memory(self) -> Memory:
        """See `Stage`."""
        parameters = self.parameters
        form = self.form.table if self.form else _ELSEWHERE
        begin = 3 if self.form is None else 2 * len(self.form.inputs)
        return Memory(form, begin, len(parameters.drives), parameters.cross_slide, parameters.deflects)
