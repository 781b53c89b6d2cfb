# SPDX-License-Identifier: Apache-2.0
"""The set point of a fine drive: a learned command, the reference, displacements to compensate."""

from collections.abc import Sequence

import numpy as np

from lathe_rc import messages
from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.cell.stage import Input
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


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
        prefix: of the parameters, where the table is part of another one.

    Attributes:
        inputs: what it reads.
        signs: with which each of them counts, shape (n,).

    Raises:
        InputError: nothing is chosen, or something twice.
    """

    def __init__(self, node: str, table: SetPointParameters, inside: Sequence[str] = (), prefix: str = "") -> None:
        if len(set(table.compensates)) < len(table.compensates):
            raise InputError(f"{node}.{prefix}compensates = {table.compensates}; allowed: each displacement once")
        if not (table.use_command or table.use_reference or table.compensates):
            names = ", ".join(prefix + name for name in ("use_command", "use_reference", "compensates"))
            raise InputError(f"{node}.{names}: there is no set point; allowed: one of them or more")
        inputs = []
        if table.use_command:
            inputs.append(Input("fine/command", messages.COMMAND, ("position",)))
        if table.use_reference:
            inputs.append(Input("reference", messages.REFERENCE, ("expected",)))
        added = len(inputs)
        inputs += [
            Input(f"{name}/state", messages.STATE, ("measured_position",))
            for name in table.compensates
            if name not in inside
        ]
        self.inputs = inputs
        self.signs = np.array([1.0] * added + [-1.0] * (len(inputs) - added))


@kernel
def sum_up(signs: Samples, inputs: tuple[Samples, ...], begin: int, samples: int) -> Samples:
    """The set point [m], shape (n,), from the inputs of a `SetPoint`, the first of which is number ``begin``."""
    set_point = np.zeros(samples)
    for place in range(signs.size):
        part = inputs[begin + place]
        if signs[place] > 0.0:
            for k in range(samples):
                set_point[k] += part[k]
        else:
            for k in range(samples):
                set_point[k] -= part[k]
    return set_point
