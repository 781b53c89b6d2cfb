# SPDX-License-Identifier: Apache-2.0
"""Joints of the machine and force on its edge, from the blocks of a cell; independent of ROS.

The joints are those of urdf/lathe.urdf. Blocks arrive topic by topic and may be missing, since delivery to a node
outside the cell is best-effort: an instant at which a topic lacks its sample is left out.
"""

from collections.abc import Iterator
from typing import NamedTuple

from lathe_rc import messages
from lathe_rc.blocks.block import Block

JOINTS = ("spindle", "z", "x", "tool")  #: names in the order of `Joints`
BED, EDGE = "bed", "edge"  #: frames of the joints' root and of the force
_MOST_WAITING = 64  # instants that wait for late topics

_Value = tuple[float, float]  # position and velocity


class Joints(NamedTuple):
    """Positions [rad] or [m] and velocities [rad/s] or [m/s] of `JOINTS` at a sample."""

    sample: int
    step_ns: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]


class Force(NamedTuple):
    """Main cutting force on the edge [N], as its sensor reads it, at a sample."""

    sample: int
    step_ns: int
    newton: float


#: position field, and velocity field or "" (then the difference of samples), by joint, by source of the joint
_JOINTS = {
    "encoder": {"spindle": ("angle", "speed")},
    "tool": {"tool": ("displacement", ""), "height": ("height", "")},
    "longitudinal": {"z": ("position", "velocity")},
    "cross": {"x": ("position", "velocity")},
}
_SOURCES = {messages.ENCODER: "encoder", messages.TOOL: "tool", messages.CUT: "cut"}
_AXES = ("longitudinal", "cross")


def source(topic: str, msgtype: str) -> str | None:
    """Return what a topic tells about the machine; None: nothing."""
    if msgtype == messages.STATE:
        axis = topic.removesuffix("/state").rpartition("/")[2]
        return axis if axis in _AXES and topic.endswith("/state") else None
    return _SOURCES.get(msgtype)


class Machine:
    """Assembler of the joints and the force at equal distances of time.

    Args:
        rate: instants per second, at most; they are at multiples of a whole number of samples.

    Attributes:
        sources: sources of joints that exist; an instant is complete when each has its sample.
        left_out: number of instants that were left out.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self.sources: set[str] = set()
        self.left_out = 0
        self._begun = False
        self._waiting: dict[int, dict[str, _Value]] = {}
        self._ends: dict[str, tuple[int, dict[str, float]]] = {}  # after the newest sample, and the newest positions

    def take(self, origin: str, block: Block) -> Iterator[Joints | Force]:
        """Add a block of a source, and yield what is complete with it."""
        end, before = self._ends.get(origin, (0, {}))
        if block.first_index < end:  # a new run
            self._waiting.clear()
        if block.first_index != end:
            before = {}
        period = max(1, -(-1_000_000_000 // round(self._rate * block.step_ns)))
        for index in range(-(-block.first_index // period) * period, block.first_index + block.samples, period):
            k = index - block.first_index
            if origin == "cut":
                yield Force(index, block.step_ns, float(block.signals["measured_force"][k]))
            elif (values := _values(origin, block, k, before)) is not None:
                self._waiting.setdefault(index, {}).update(values)
                yield from self._complete(index, block.step_ns)
        newest = {name: float(block.signals[name][-1]) for name, _ in _JOINTS.get(origin, {}).values()}
        self._ends[origin] = block.first_index + block.samples, newest

    def _complete(self, index: int, step_ns: int) -> Iterator[Joints]:
        values = self._waiting[index]
        if values.keys() >= {joint for origin in self.sources for joint in _JOINTS[origin]}:
            for earlier in [each for each in self._waiting if each <= index]:
                del self._waiting[earlier]
                self.left_out += self._begun and earlier < index
            self._begun = True
            z = values.get("z", values.get("height", (0.0, 0.0)))
            into = values.get("x", (0.0, 0.0))  # positive into the part
            still = (0.0, 0.0)
            ordered = (values.get("spindle", still), z, (-into[0], -into[1]), values.get("tool", still))
            yield Joints(index, step_ns, tuple(p for p, _ in ordered), tuple(v for _, v in ordered))
        elif len(self._waiting) > _MOST_WAITING:
            del self._waiting[min(self._waiting)]
            self.left_out += 1


def _values(origin: str, block: Block, k: int, before: dict[str, float]) -> dict[str, _Value] | None:
    """Return the joints of a source at a sample of a block; None if a velocity lacks the sample before it."""
    found = {}
    for joint, (name, rate) in _JOINTS[origin].items():
        samples = block.signals[name]
        if rate:
            velocity = float(block.signals[rate][k])
        elif k or name in before:
            velocity = (float(samples[k]) - (float(samples[k - 1]) if k else before[name])) * 1e9 / block.step_ns
        elif block.first_index == 0:
            velocity = 0.0
        else:
            return None
        found[joint] = float(samples[k]), velocity
    return found
