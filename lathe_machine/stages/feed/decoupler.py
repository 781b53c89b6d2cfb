# SPDX-License-Identifier: Apache-2.0
"""Decoupler of the force and position loops (paper 004, Figs 5 and 10)."""

from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Le

from lathe_machine.control.decoupler import (
    LAG,
    LEAK,
    PRESETS,
    Channels,
    Decoupler,
    DecouplerTable,
    compensators,
    decouple_along,
)
from lathe_machine.transfer import TransferFunction
from lathe_rc import messages
from lathe_rc.arrays import put
from lathe_rc.blocks.ports import Input, Output
from lathe_rc.cell.parameters import NodeParameters, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

_CHANNELS = ("w1", "w2", "w3", "w4")


class DecouplerParameters(NodeParameters):
    """Plant model from which K1 and K2 are computed, and the selection of active decouplers."""

    preset: Literal["paper", "realistic"] = parameter("realistic", "model of the plant; paper: W3 as it is printed")
    w1_numerator: list[float] = parameter(
        [], "force over the longitudinal command [N], falling powers of p; empty: that of the preset"
    )
    w1_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    w2_numerator: list[float] = parameter(
        [], "position over the cross command [m]; empty: that of the preset", drive="transfer.numerator"
    )
    w2_denominator: list[float] = parameter(
        [], "its denominator; empty: that of the preset", drive="transfer.denominator"
    )
    w3_numerator: list[float] = parameter([], "deflection over force [m/N]; empty: that of the preset")
    w3_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    w4_numerator: list[float] = parameter([], "force over position [N/m]; empty: that of the preset")
    w4_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    k1: bool = parameter(default=True, doc="takes the effect of the cross command off the force")
    k2: bool = parameter(default=True, doc="takes the effect of the longitudinal command off the position")
    inverse_lag: Positive = parameter(LAG, "lag for each order that an inverse is missing", "s")
    leak: Annotated[float, Ge(0), Le(1e6)] = parameter(LEAK, "of the integrators in K1 and K2; 0: none", "rad/s")

    commanded_topic: ClassVar[str] = "cross/command"  #: of W2; W1, W3 and W4 do not belong to a single drive

    def channels(self, node: str) -> Channels:
        """Return the plant model of a node.

        Raises:
            InputError: a transfer function is incomplete or not proper.
        """
        preset, made = PRESETS[self.preset], {}
        for name in _CHANNELS:
            top, bottom = getattr(self, f"{name}_numerator"), getattr(self, f"{name}_denominator")
            if bool(top) != bool(bottom):
                raise InputError(f"{node}.{name}_numerator and {name}_denominator; give both or none")
            with about(node, f"{name}_numerator", f"{name}_denominator"):
                made[name] = TransferFunction(tuple(top), tuple(bottom)) if top else getattr(preset, name)
        return Channels(**made)


@kernel
def step(memory: DecouplerTable, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Decouple the commands of one block; set points and errors are passed on unchanged."""
    force, position = inputs[0], inputs[3]
    for place in (1, 2, 4, 5):
        put(outputs[place], inputs[place])
    decouple_along(memory, force, position, outputs[0], outputs[3])
    return force.size, DONE


class DecouplerStage(Stage):
    """Decoupler of the force and position loops (see `lathe_machine.control.decoupler`)."""

    kind = "decoupler"
    Parameters = DecouplerParameters
    parameters: DecouplerParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: DecouplerParameters) -> None:
        super().__init__(name, parameters)
        channels = parameters.channels(name)
        with about(name, "w1_numerator", "w2_numerator", "inverse_lag"):  # inverted models, and the inverse's lag
            k1, k2 = compensators(channels, parameters.inverse_lag, parameters.leak)
        self._decoupler = Decoupler(k1 if parameters.k1 else None, k2 if parameters.k2 else None, parameters.step)
        fields = ("command", "set_point", "error")
        self.declare(
            inputs=[
                Input("longitudinal/demand", messages.SERVO, fields),
                Input("cross/demand", messages.SERVO, fields),
            ],
            outputs=[
                Output("longitudinal/command", messages.SERVO),
                Output("cross/command", messages.SERVO),
            ],
        )

    @property
    def memory(self) -> DecouplerTable:
        """Current state of the decoupler's step function."""
        return self._decoupler.table
