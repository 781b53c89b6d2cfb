# SPDX-License-Identifier: Apache-2.0
"""Injection of faults into the input and output blocks of a stage."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lathe_rc import messages
from lathe_rc.errors import InputError
from lathe_rc.messages import Signals
from lathe_rc.safety.faults import DISTURBANCES, KINDS, Disturbance, Fault, Kind, parse

_TRUE = "_true"  # suffix of fields with true values, which cannot be faulty


@dataclass(frozen=True)
class Port:
    """Input or output of a stage, as a target of faults.

    Attributes:
        topic: name of the topic in the cell.
        type: message type.
        fields: used fields of the message.
        delay: delay of the samples [sample].
        out: whether the stage publishes the topic.
    """

    topic: str
    type: str
    fields: tuple[str, ...]
    delay: int
    out: bool

    def targets(self, kind: Kind) -> set[str]:
        """Return the possible targets of a kind of fault at this port."""
        if kind.what == "encoder":
            return {self.topic} if self.out and self.type == messages.ENCODER else set()
        if kind.what != "field":
            return set()
        types = messages.sample_fields(self.type)
        fields = {name for name in self.fields if not name.endswith(_TRUE) and (kind.whole or types[name].kind == "f")}
        return {f"{self.topic}.{name}" for name in fields}

    def takes(self, fault: Fault) -> bool:
        """Return whether the target of a fault is at this port."""
        return fault.target in self.targets(KINDS[fault.kind])


@dataclass
class _Injected:
    """Fault injected at port number ``place`` from sample ``start`` of the topic up to but not including ``end``."""

    fault: Fault
    place: int
    delay: int
    disturbance: Disturbance
    start: int
    end: float = math.inf

    def apply(self, first: int, signals: Signals) -> None:
        """Apply the fault in place to samples starting at ``first``, an index in the node's time."""
        first -= self.delay  # the fault refers to the topic's samples, which a delayed reader receives later
        samples = next(iter(signals.values())).size
        begin = min(max(self.start - first, 0), samples)
        stop = int(min(max(self.end - first, begin), samples))
        if begin < stop:
            self.disturbance.during({name: array[begin:stop] for name, array in signals.items()})
        if stop < samples and self.end < first + samples:
            self.disturbance.after({name: array[stop:] for name, array in signals.items()})


class Injection:
    """Injection of faults at the ports and devices of a stage.

    Args:
        node: name of the node.
        inputs, outputs: ports of the stage, in order.
        devices: devices of the stage that can be faulty, in addition to the ports.
        seed: seed of the cell.
        step: sampling step [s].
    """

    def __init__(
        self,
        node: str,
        inputs: Sequence[Port],
        outputs: Sequence[Port],
        *,
        devices: Sequence[str] = (),
        seed: int,
        step: float,
    ) -> None:
        self._node, self._inputs, self._outputs, self._devices = node, list(inputs), list(outputs), devices
        self._seed, self._step = seed, step
        self._injected: list[_Injected] = []

    @property
    def _ports(self) -> list[Port]:
        return [*self._inputs, *self._outputs]

    def targets(self, kind: Kind) -> set[str]:
        """Return the possible targets of a kind of fault at this stage."""
        if kind.what in self._devices:
            return {kind.what}
        return {target for port in self._ports for target in port.targets(kind)}

    def targets_by_kind(self) -> dict[str, list[str]]:
        """Return the possible targets of each kind of fault that has any."""
        found = {name: sorted(self.targets(kind)) for name, kind in KINDS.items()}
        return {name: targets for name, targets in found.items() if targets}

    def parse(self, text: str, verb: str = "fault") -> Fault:
        """Return the fault in the text of an event (see `lathe_rc.safety.faults.parse`)."""
        return parse(text, self._node, what=verb)

    def is_of_device(self, fault: Fault) -> bool:
        """Return whether a fault is of a device of the stage, not of a port."""
        return KINDS[fault.kind].what in self._devices

    def check(self, fault: Fault) -> None:
        """Check that a fault is possible for its target.

        Raises:
            InputError: the fault is not possible; the message names the allowed targets.
        """
        allowed = self.targets(KINDS[fault.kind])
        if fault.target in allowed:
            return
        others = [name for name, kind in KINDS.items() if fault.target in self.targets(kind)]
        raise InputError(
            f"{self._node}: fault {fault.text!r}: no such target for it; allowed for {fault.kind}: "
            f"{', '.join(sorted(allowed)) or 'none of this node'}"
            + (f"; for {fault.target}: {', '.join(others)}" if others else "")
        )

    def check_target(self, target: str) -> None:
        """Check that a target exists at this stage.

        Raises:
            InputError: no fault is possible for the target; the message names the allowed targets.
        """
        allowed = {each for kind in KINDS.values() for each in self.targets(kind)}
        if target not in allowed:
            raise InputError(
                f"{self._node}: repair {target!r}: there is no such target; allowed: {', '.join(sorted(allowed))}"
            )

    def begin(self, fault: Fault, index: int) -> None:
        """Start a fault at sample ``index``."""
        for place, port in enumerate(self._ports):
            if port.takes(fault):
                made = DISTURBANCES[fault.kind](fault, seed=self._seed, step=self._step, whose=self._node)
                self._injected.append(_Injected(fault, place, port.delay, made, index))

    def end(self, target: str, index: int, fault: Fault | None = None) -> bool:
        """End the oldest instance of ``fault``, or by default all faults of a target, before sample ``index``.

        Returns:
            Whether there was such a fault.
        """
        found = False
        for injected in self._injected:
            if injected.fault.target == target and fault in (None, injected.fault) and injected.end > index:
                injected.end, found = index, True
                if fault is not None:
                    break
        return found

    @property
    def any(self) -> bool:
        """Whether there is or was any fault; ended faults matter, since lost counts stay lost after a repair."""
        return bool(self._injected)

    def inputs(self, first: int, inputs: Sequence[Signals]) -> list[Signals]:
        """Return the inputs with their faults; faulty signals are copies, since other stages read the originals."""
        changed = list(inputs)
        for place in range(len(self._inputs)):
            mine = [injected for injected in self._injected if injected.place == place]
            if mine:
                changed[place] = {name: array.copy() for name, array in inputs[place].items()}
            for injected in mine:
                injected.apply(first, changed[place])
        return changed

    def outputs(self, first: int, outputs: Sequence[Signals]) -> None:
        """Apply the faults to the outputs of the stage in place."""
        for injected in self._injected:
            if (place := injected.place - len(self._inputs)) >= 0:
                injected.apply(first, outputs[place])
