# SPDX-License-Identifier: Apache-2.0
"""Decoupler between the force and the position loop (paper 004, Figs 5 and 10)."""

from collections.abc import Sequence
from typing import Annotated, Literal

from annotated_types import Ge, Gt

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.cell.stage import Input, Output, Sparse, Stage
from lathe_rc.control.decoupler import LAG, LEAK, PRESETS, Channels, Decoupler, compensators
from lathe_rc.errors import InputError
from lathe_rc.transfer import TransferFunction

_CHANNELS = ("w1", "w2", "w3", "w4")


class DecouplerParameters(NodeParameters):
    """The model of the plant by which K1 and K2 are made, and which of them are on."""

    preset: Literal["paper", "realistic"] = parameter("realistic", "model of the plant; paper: W3 as it is printed")
    w1_numerator: list[float] = parameter(
        [], "force over the longitudinal command [N], falling powers of p; empty: that of the preset"
    )
    w1_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    w2_numerator: list[float] = parameter([], "position over the cross command [m]; empty: that of the preset")
    w2_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    w3_numerator: list[float] = parameter([], "deflection over force [m/N]; empty: that of the preset")
    w3_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    w4_numerator: list[float] = parameter([], "force over position [N/m]; empty: that of the preset")
    w4_denominator: list[float] = parameter([], "its denominator; empty: that of the preset")
    k1: bool = parameter(default=True, doc="takes the effect of the cross command off the force")
    k2: bool = parameter(default=True, doc="takes the effect of the longitudinal command off the position")
    inverse_lag: Annotated[float, Gt(0)] = parameter(LAG, "lag for each order that an inverse is missing", "s")
    leak: Annotated[float, Ge(0)] = parameter(LEAK, "of the integrators in K1 and K2; 0: none", "rad/s")

    def channels(self, node: str) -> Channels:
        """The model of the plant.

        Raises:
            InputError: half a transfer function, or one that is not proper.
        """
        preset, made = PRESETS[self.preset], {}
        for name in _CHANNELS:
            top, bottom = getattr(self, f"{name}_numerator"), getattr(self, f"{name}_denominator")
            if bool(top) != bool(bottom):
                raise InputError(f"{node}.{name}_numerator and {name}_denominator; give both or none")
            made[name] = TransferFunction(tuple(top), tuple(bottom)) if top else getattr(preset, name)
        return Channels(**made)


class DecouplerStage(Stage):
    """See `lathe_rc.control.decoupler`.

    Attributes:
        parameters: its table.
    """

    kind = "decoupler"
    Parameters = DecouplerParameters

    def __init__(self, name: str, parameters: DecouplerParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        k1, k2 = compensators(parameters.channels(name), parameters.inverse_lag, parameters.leak)
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

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`; set points and errors go on unchanged."""
        for demand, command in zip(inputs, outputs, strict=True):
            command["set_point"][:], command["error"][:] = demand["set_point"], demand["error"]
        (force, position), (longitudinal, cross) = inputs, outputs
        self._decoupler.block(force["command"], position["command"], longitudinal["command"], cross["command"])
        return []
