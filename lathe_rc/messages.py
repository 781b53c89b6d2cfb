# SPDX-License-Identifier: Apache-2.0
"""Message types of the cell, read from their .msg files, and CDR encoding without ROS."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict

PACKAGE = "lathe_rc_msgs"

ENCODER = f"{PACKAGE}/msg/EncoderBlock"
COMMAND = f"{PACKAGE}/msg/ActuatorCommand"
STATE = f"{PACKAGE}/msg/ActuatorState"
TOOL = f"{PACKAGE}/msg/ToolBlock"
REFERENCE = f"{PACKAGE}/msg/ReferenceBlock"
SERVO = f"{PACKAGE}/msg/ServoCommand"
CUT = f"{PACKAGE}/msg/CutBlock"
PERIODIC = f"{PACKAGE}/msg/PeriodicStatus"
LEARNING = f"{PACKAGE}/msg/LearningStatus"
EVENT = f"{PACKAGE}/msg/Event"
MARGIN = f"{PACKAGE}/msg/MarginBlock"
SAFETY = f"{PACKAGE}/msg/SafetyBlock"
SAFETY_STATUS = f"{PACKAGE}/msg/SafetyStatus"
CELL_STATE = f"{PACKAGE}/msg/CellState"
JOINTS = "sensor_msgs/msg/JointState"
ALIVE = "alive"  #: topic on which each node asserts its liveliness; it carries no messages

#: types of the topics that carry blocks, by the last component of their names
BLOCK_TOPICS = {
    "encoder": ENCODER,
    "tool": TOOL,
    "cut": CUT,
    "command": COMMAND,
    "state": STATE,
    "margin": MARGIN,
}

START_NS = 1_000_000_000  #: simulated time of sample 0 [ns]; a stamp of 0 means "not set" in ROS
MAX_BLOCK = 8192  #: maximum length of the arrays of a block [sample], as in the .msg files

NOT_SIGNALS = {"header", "run_id", "source", "__msgtype__"}  #: fields of sparse messages that are excluded from digests

Samples = npt.NDArray[Any]
Signals = dict[str, Samples]  #: the arrays of a block by field name


@cache
def _own() -> "Typesdict":
    """Return the message types of lathe_rc."""
    found: Typesdict = {}
    for path in sorted((Path(__file__).with_name("msg_defs") / "msg").glob("*.msg")):
        found.update(get_types_from_msg(path.read_text(encoding="utf-8"), f"{PACKAGE}/msg/{path.stem}"))
    return found


@cache
def store() -> Typestore:
    """Return the type store with the message types of ROS 2 and lathe_rc.

    Loading the store takes a while, and a run without a bag does not need it.
    """
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(_own())
    return types


def fields(msgtype: str) -> list[tuple[str, Any]]:
    """Return the names and kinds of a message type's fields, in order, in the format of rosbags."""
    return list((_own() if msgtype in _own() else store().fielddefs)[msgtype][1])


def _with(field: str) -> frozenset[str]:
    """Return the message types of lathe_rc that have a given field."""
    return frozenset(name for name in _own() if any(field == given for given, _ in fields(name)))


@cache
def block_types() -> frozenset[str]:
    """Return the message types of topics with one message per block."""
    return _with("block")


@cache
def sparse_types() -> frozenset[str]:
    """Return the message types of topics with messages at individual samples."""
    return _with("sample_index") | {JOINTS}


@cache
def signal_types() -> frozenset[str]:
    """Return the message types of all signal topics."""
    return block_types() | sparse_types()


@cache
def sample_fields(msgtype: str) -> dict[str, np.dtype[Any]]:
    """Return the array fields of a block type, in order, with their element types."""
    found = {}
    for name, (kind, detail) in fields(msgtype):
        if kind == Nodetype.SEQUENCE:
            ((_, (element, _)), _) = cast("tuple[tuple[Any, tuple[str, int]], int]", detail)
            found[name] = np.dtype(element)
    return found


def full(topic: str) -> str:
    """Return the fully qualified name of a topic; the engine's topic names have no leading slash."""
    return "/" + topic.lstrip("/")


def allocate(msgtype: str, samples: int) -> Signals:
    """Return zeroed arrays for ``samples`` samples of a block type."""
    return {name: np.zeros(samples, dtype) for name, dtype in sample_fields(msgtype).items()}


def header(index: int, step_ns: int) -> Any:
    """Return a std_msgs/Header with the simulated time of sample ``index``."""
    seconds, nanoseconds = divmod(START_NS + index * step_ns, 1_000_000_000)
    types = store().types
    stamp = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    return types["std_msgs/msg/Header"](stamp, "")


def stamp_ns(message: Any) -> int:
    """Return the simulated time [ns] in a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_of(data: bytes | memoryview) -> int:
    """Return the simulated time [ns] of an encoded message, decoding only the time stamp of its header."""
    stamp = decode("builtin_interfaces/msg/Time", bytes(data[:12]))  # the header's first field
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def encode(msgtype: str, message: Any) -> bytes:
    """Encode a message as CDR bytes, padded to a multiple of four bytes as in DDS."""
    data = bytes(store().serialize_cdr(message, msgtype))
    return data + bytes(-len(data) % 4)


def values_of(msgtype: str, data: bytes) -> dict[str, Any]:
    """Return the fields of an encoded message, without its header, source and run ID.

    Raises:
        ValueError: the bytes are not a message of this type.
    """
    return signals_of(decode(msgtype, data))


def signals_of(message: Any) -> dict[str, Any]:
    """Return the fields of a message, without its constants, header, source and run ID."""
    return {name: getattr(message, name) for name, _ in fields(message.__msgtype__) if name not in NOT_SIGNALS}


def decode(msgtype: str, data: bytes) -> Any:
    """Decode a message from CDR bytes; its arrays are views of the bytes.

    Raises:
        ValueError: the bytes are not a message of this type.
    """
    try:
        return store().deserialize_cdr(data, msgtype)
    except Exception as error:  # noqa: BLE001 - rosbags' generated code can raise any exception on damaged bytes
        raise ValueError(f"{msgtype} cannot be decoded ({type(error).__name__})") from None
