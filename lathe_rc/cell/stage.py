# SPDX-License-Identifier: Apache-2.0
"""Stages: what turns input blocks number k into output blocks number k.

A stage's output depends on its parameters, its state and its declared inputs alone; the length of the blocks
changes no bit. Hosts (the offline engine, a ROS node) feed it in order and know nothing of what it does.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.errors import InputError


@dataclass(frozen=True)
class Input:
    """Samples that a stage reads.

    Attributes:
        topic: relative name, before remapping.
        type: message type.
        fields: those that the stage reads.
        delay: 0 for a forward edge: block k is complete before the stage computes block k. Otherwise a feedback
            edge: at sample n the stage sees sample n - delay, and zeros before sample ``delay``.
    """

    topic: str
    type: str
    fields: tuple[str, ...]
    delay: int = 0


class Joint(NamedTuple):
    """Which fields of an output make a decimated sensor_msgs/JointState."""

    position: str
    velocity: str | None = None
    effort: str | None = None


@dataclass(frozen=True)
class Output:
    """A topic on which a stage publishes one block for each block."""

    topic: str
    type: str
    joint: Joint | None = None


@dataclass(slots=True)
class Sparse:
    """A message that comes at a chosen sample, not one a block."""

    topic: str
    type: str
    index: int
    values: dict[str, Any] = field(compare=False)


@dataclass(frozen=True)
class Trigger:
    """When an event takes effect."""

    kind: str  # revolution, second or sample
    value: float
    action: str


_NOTHING = np.empty(0)

_EVENT = re.compile(r"\s*(revolution|second|sample)\s+([0-9.eE+-]+)\s*:\s*(\S.*?)\s*")


class Stage(ABC):
    """Base of all stages.

    Args:
        name: of the node, without namespace.
        parameters: its table.

    Attributes:
        inputs, outputs: the ports; the arrays handed to `advance` stand in their order.
        sparse_topics: relative name and type of every topic that carries `Sparse` messages.
    """

    kind: ClassVar[str]
    Parameters: ClassVar[type[NodeParameters]]
    actions: ClassVar[tuple[str, ...]] = ()  #: events that it knows
    announces: ClassVar[tuple[str, ...]] = ()  #: events that come about by themselves

    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()

    def __init__(self, name: str, parameters: NodeParameters) -> None:
        self.name = name
        self.shared = parameters
        self.sparse_topics: dict[str, str] = {}
        self._triggers = [self._trigger(text) for text in parameters.events]
        self._scheduled: list[tuple[int, str]] = []

    def declare(self, *, inputs: Sequence[Input] = (), outputs: Sequence[Output] = ()) -> None:
        """Set the ports; to be called once, at the end of the constructor."""
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self._joints = [(place, output.joint) for place, output in enumerate(self.outputs) if output.joint]
        if self._joints:
            self.sparse_topics[f"{self.name}/joint_states"] = messages.JOINTS
        if self.actions:
            self.sparse_topics[f"{self.name}/events"] = messages.EVENT
        for trigger in self._triggers:
            if trigger.kind == "revolution" and self._angle() is None:
                raise InputError(
                    f"{self.name}.events: {self.kind} does not see the spindle, so revolution {trigger.value:g} "
                    "means nothing to it; give second or sample"
                )

    def _trigger(self, text: str) -> Trigger:
        match = _EVENT.fullmatch(text)
        try:
            trigger = Trigger(match[1], float(match[2]), match[3]) if match else None
        except ValueError:
            trigger = None
        if trigger is None or not 0 <= trigger.value < math.inf:
            raise InputError(
                f"{self.name}.events = {text!r}; allowed: 'revolution R: ACTION', 'second T: ACTION' or "
                "'sample N: ACTION'"
            )
        self.check_action(trigger.action)
        return trigger

    def check_action(self, action: str) -> None:
        """Refuse an event that cannot be carried out.

        Raises:
            InputError: the stage does not know it, or lacks what it needs.
        """
        if action not in self.actions:
            known = ", ".join(self.actions) or f"none ({self.kind} has no events)"
            raise InputError(f"{self.name}: event {action!r}; allowed: {known}")

    def schedule(self, action: str, index: int) -> None:
        """Let an event take effect at sample ``index``, which the host has not issued yet.

        Raises:
            InputError: the stage cannot carry it out.
        """
        self.check_action(action)
        self._scheduled.append((index, action))

    def _scheduled_actions(self, action: str) -> bool:
        """Whether the scenario lists an event with this action."""
        return any(trigger.action == action for trigger in self._triggers)

    def _angle(self) -> tuple[int, str] | None:
        """Input and field with the measured spindle angle, if the stage reads it."""
        for place, port in enumerate(self.inputs):
            if port.type == messages.ENCODER and port.delay == 0 and "angle" in port.fields:
                return place, "angle"
        return None

    def _due(self, first: int, samples: int, inputs: Sequence[Signals]) -> list[tuple[int, str]]:
        """Take the events that fall into a block, by sample index; equal indices keep the order of scheduling."""
        waiting = []
        for trigger in self._triggers:
            if trigger.kind == "sample":
                index = int(np.ceil(trigger.value))
            elif trigger.kind == "second":
                # The factor keeps 0.1 s · 64000 from becoming sample 6401.
                index = int(np.ceil(trigger.value * self.shared.sample_rate * (1 - 1e-12)))
            else:
                place = self._angle()
                assert place is not None, "declare() refuses revolutions without an angle"
                angle = inputs[place[0]][place[1]]
                index = first + int(np.searchsorted(angle, trigger.value * 2 * np.pi))
            if index < first + samples:
                self._scheduled.append((max(index, first), trigger.action))
            else:
                waiting.append(trigger)
        self._triggers = waiting
        due = sorted((event for event in self._scheduled if event[0] < first + samples), key=lambda event: event[0])
        self._scheduled = [event for event in self._scheduled if event[0] >= first + samples]
        return due

    def advance(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute one block.

        Args:
            first: index of its first sample.
            inputs: arrays of shape (n,) by field, in the order of the ports.
            outputs: the same, to be filled.

        Returns:
            The sparse messages of the block, by sample index.
        """
        if self._triggers or self._scheduled:
            sparse = self._advance_with_events(first, inputs, outputs)
        else:
            sparse = self.process(first, inputs, outputs)
        for place, joint in self._joints:
            sparse = sparse + self._joint_states(first, joint, outputs[place])
        if len(sparse) > 1:
            sparse.sort(key=lambda message: message.index)
        return sparse

    def _advance_with_events(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute a block in pieces, from event to event."""
        samples = next(iter(outputs[0].values())).size
        sparse: list[Sparse] = []
        start = 0
        for index, action in self._due(first, samples, inputs):
            sparse += self._compute(first, start, index - first, inputs, outputs)
            start = index - first
            self.perform(action)
            sparse.append(Sparse(f"{self.name}/events", messages.EVENT, index, {"action": action}))
        return sparse + self._compute(first, start, samples, inputs, outputs)

    def _compute(
        self, first: int, start: int, stop: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        if start == stop:
            return []
        return self.process(first + start, _cut(inputs, start, stop), _cut(outputs, start, stop))

    def _joint_states(self, first: int, joint: Joint, signals: Signals) -> list[Sparse]:
        period = self.shared.joint_state_period
        samples = signals[joint.position].size
        start = -first % period
        if start >= samples:
            return []

        # Copies: the block's own arrays are used again.
        position = signals[joint.position][start::period].copy()
        velocity = signals[joint.velocity][start::period].copy() if joint.velocity else None
        effort = signals[joint.effort][start::period].copy() if joint.effort else None
        topic, found = f"{self.name}/joint_states", []
        for k in range(position.size):
            values = {
                "name": [self.name],
                "position": position[k : k + 1],
                "velocity": _NOTHING if velocity is None else velocity[k : k + 1],
                "effort": _NOTHING if effort is None else effort[k : k + 1],
            }
            found.append(Sparse(topic, messages.JOINTS, first + start + k * period, values))
        return found

    def perform(self, action: str) -> None:
        """Carry out an event; the samples from now on feel it.

        Stages with ``actions`` have their own; the others' events never get here, see `check_action`.
        """
        raise NotImplementedError(action)

    @abstractmethod
    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute samples ``first`` on; see `advance`."""


def _cut(signals: Sequence[Signals], start: int, stop: int) -> list[Signals]:
    return [{name: samples[start:stop] for name, samples in part.items()} for part in signals]


def compile_kernels(stage: Stage) -> None:
    """Compile what the stage runs, by an empty block: the first real block then takes no longer than the next."""
    inputs = [
        {name: np.empty(0, messages.sample_fields(port.type)[name]) for name in port.fields} for port in stage.inputs
    ]
    stage.process(0, inputs, [messages.allocate(port.type, 0) for port in stage.outputs])
