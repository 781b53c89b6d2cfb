# SPDX-License-Identifier: Apache-2.0
"""Faults at the ports of a stage: which there may be, and what they do to the blocks that go through."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.errors import InputError
from lathe_rc.safety.faults import DISTURBANCES, KINDS, Disturbance, Fault

_TRUE = "_true"  # fields with this ending are what really happens


@dataclass(frozen=True)
class Port:
    """An input or output as faults see it.

    Attributes:
        topic: as the cell calls it.
        type: message type.
        fields: those that go through.
        delay: samples by which they come late.
        out: the stage publishes it.
    """

    topic: str
    type: str
    fields: tuple[str, ...]
    delay: int
    out: bool

    def takes(self, fault: Fault) -> bool:
        """Whether the fault is one of this port."""
        kind = KINDS[fault.kind]
        if kind.what == "encoder":
            return self.out and self.type == messages.ENCODER and fault.target == self.topic
        topic, _, field = fault.target.rpartition(".")
        if kind.what != "field" or topic != self.topic or field not in self.fields or field.endswith(_TRUE):
            return False
        return kind.whole or messages.sample_fields(self.type)[field].kind == "f"


@dataclass
class _Injected:
    """A fault at a port, from sample ``start`` of the topic on and before sample ``end``."""

    fault: Fault
    port: Port
    disturbance: Disturbance
    start: int
    end: float = math.inf

    def apply(self, first: int, signals: Signals) -> None:
        """Change samples ``first`` on of the node's time in place."""
        first -= self.port.delay
        samples = next(iter(signals.values())).size
        begin = min(max(self.start - first, 0), samples)
        stop = int(min(max(self.end - first, begin), samples))
        if begin < stop:
            self.disturbance.during({name: array[begin:stop] for name, array in signals.items()})
        if stop < samples and self.end < first + samples:
            self.disturbance.after({name: array[stop:] for name, array in signals.items()})


class Injection:
    """The faults of a stage's ports.

    Args:
        node: its name.
        inputs, outputs: its ports, in order.
        seed: of the cell.
        step: sampling step [s].
    """

    def __init__(self, node: str, inputs: Sequence[Port], outputs: Sequence[Port], *, seed: int, step: float) -> None:
        self._node, self._inputs, self._outputs = node, list(inputs), list(outputs)
        self._seed, self._step = seed, step
        self._injected: list[_Injected] = []

        ports = [*self._inputs, *self._outputs]
        self._fields = {f"{port.topic}.{name}" for port in ports for name in port.fields if not name.endswith(_TRUE)}
        self._encoders = {port.topic for port in self._outputs if port.type == messages.ENCODER}

    def check(self, fault: Fault) -> None:
        """Refuse a fault that no port can have.

        Raises:
            InputError: says which ports there are.
        """
        if not any(port.takes(fault) for port in [*self._inputs, *self._outputs]):
            self._refuse(f"fault {fault.text!r}: no such target for it")

    def check_target(self, target: str) -> None:
        """Refuse a target that no fault of a port can have.

        Raises:
            InputError: says which there are.
        """
        if target not in self._fields | self._encoders:
            self._refuse(f"repair {target!r}: there is no such target")

    def _refuse(self, why: str) -> NoReturn:
        raise InputError(
            f"{self._node}: {why}; allowed: {', '.join(sorted(self._fields))}"
            + (f"; {', '.join(self._encoders)} for faults of the encoder itself" if self._encoders else "")
        )

    def begin(self, fault: Fault, index: int) -> None:
        """Let a fault begin at sample ``index``."""
        for port in (port for port in [*self._inputs, *self._outputs] if port.takes(fault)):
            made = DISTURBANCES[fault.kind](fault, seed=self._seed, step=self._step, whose=self._node)
            self._injected.append(_Injected(fault, port, made, index))

    def end(self, target: str, index: int, fault: Fault | None = None) -> None:
        """Let a fault of a target, of equal ones the oldest, or all of them, end before sample ``index``."""
        for injected in self._injected:
            if injected.fault.target == target and fault in (None, injected.fault) and injected.end > index:
                injected.end = index
                if fault is not None:
                    return

    @property
    def any(self) -> bool:
        """Whether there is a fault, or has been: some leave something."""
        return bool(self._injected)

    def inputs(self, first: int, inputs: Sequence[Signals]) -> list[Signals]:
        """What the stage gets; what others read as well stays as it is."""
        changed = list(inputs)
        for place, port in enumerate(self._inputs):
            mine = [injected for injected in self._injected if injected.port is port]
            if mine:
                changed[place] = {name: array.copy() for name, array in inputs[place].items()}
            for injected in mine:
                injected.apply(first, changed[place])
        return changed

    def outputs(self, first: int, outputs: Sequence[Signals]) -> None:
        """Change in place what the stage publishes."""
        for injected in self._injected:
            if injected.port.out:
                injected.apply(first, outputs[self._outputs.index(injected.port)])
