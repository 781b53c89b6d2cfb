# SPDX-License-Identifier: Apache-2.0
"""What a fine drive is asked for: a learned command, the reference, displacements to compensate."""

from collections.abc import Sequence

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples, Signals
from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.cell.stage import Input
from lathe_rc.errors import InputError


class SetPointParameters(NodeParameters):
    """The set point is command + reference - what is compensated, each where it is chosen."""

    use_command: bool = parameter(default=True, doc="the set point has the learned command in it")
    use_reference: bool = parameter(
        default=False, doc="the set point has the desired displacement at the measured angle in it"
    )
    compensates: list[str] = parameter(
        [],
        "displacements whose measurement is taken off the set point, by the first word of their state topic; direct "
        "compensation (paper 001, Fig. 4) is the reference with coarse, or vibration alone",
    )


class SetPoint:
    """The sum that a table chooses.

    Args:
        node: that it is for.
        table: its parameters.
        inside: compensated displacements that the drive itself knows and no topic has to bring.

    Attributes:
        inputs: what it reads.

    Raises:
        InputError: nothing is chosen, or something twice.
    """

    def __init__(self, node: str, table: SetPointParameters, inside: Sequence[str] = ()) -> None:
        if len(set(table.compensates)) < len(table.compensates):
            raise InputError(f"{node}: compensates {', '.join(table.compensates)}; allowed: each displacement once")
        if not (table.use_command or table.use_reference or table.compensates):
            raise InputError(
                f"{node} has no set point; choose the command, the reference, or a displacement that it compensates"
            )
        inputs = []
        if table.use_command:
            inputs.append(Input("fine/command", messages.COMMAND, ("position",)))
        if table.use_reference:
            inputs.append(Input("reference", messages.REFERENCE, ("expected",)))
        self._added = len(inputs)
        inputs += [
            Input(f"{name}/state", messages.STATE, ("measured_position",))
            for name in table.compensates
            if name not in inside
        ]
        self.inputs = inputs

    def fill(self, inputs: Sequence[Signals], set_point: Samples) -> None:
        """Fill ``set_point`` [m], shape (n,), from the arrays of `inputs`."""
        set_point[:] = 0.0
        for place, (port, signals) in enumerate(zip(self.inputs, inputs, strict=True)):
            if place < self._added:
                set_point += signals[port.fields[0]]
            else:
                set_point -= signals[port.fields[0]]
