# SPDX-License-Identifier: Apache-2.0
"""Ports of a stage: topics that it reads and publishes, and messages at chosen samples."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from lathe_rc import messages


@dataclass(frozen=True)
class Input:
    """Input port of a stage: the samples that the stage reads from a topic.

    Attributes:
        topic: relative name, before remapping.
        type: message type.
        fields: fields that the stage reads.
        delay: 0 for a forward edge: block k is complete before the stage computes block k. Otherwise a feedback
            edge: at sample n the stage sees sample n - delay, and zeros before sample ``delay``.
    """

    topic: str
    type: str
    fields: tuple[str, ...]
    delay: int = 0


#: input of a stage that does not use the angle itself: the spindle's blocks determine which samples are due
CLOCK = Input("encoder", messages.ENCODER, ("angle",))


class Joint(NamedTuple):
    """Selection of the fields of an output that form a decimated sensor_msgs/JointState."""

    position: str
    velocity: str | None = None
    effort: str | None = None


@dataclass(frozen=True)
class Output:
    """Output port of a stage: a topic with one block per input block."""

    topic: str
    type: str
    joint: Joint | None = None


@dataclass(slots=True)
class Sparse:
    """Message at a chosen sample, instead of one per block."""

    topic: str
    type: str
    index: int
    values: dict[str, Any] = field(compare=False)


_SPARE, _FREE_RUNNING = 32, 2080  # messages


def signal_depth(window: int) -> int:
    """Return the queue length of signal topics: all blocks in flight plus a reserve; large without flow control.

    A publisher may be one window ahead, and a reader that replaces a dead one starts two windows back.
    """
    return 3 * window + _SPARE if window else _FREE_RUNNING
