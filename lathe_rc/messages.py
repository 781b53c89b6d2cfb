# SPDX-License-Identifier: Apache-2.0
"""The message types of the cell, read from their .msg files; CDR without ROS."""

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
MEMBER = f"{PACKAGE}/msg/Member"
CELL_STATE = f"{PACKAGE}/msg/CellState"
JOINTS = "sensor_msgs/msg/JointState"
ALIVE = "alive"  #: topic of each node without messages: only its liveliness counts

START_NS = 1_000_000_000  #: simulated time of sample 0 [ns]; a stamp of 0 means "not set" in ROS
MAX_BLOCK = 8192  #: bound of the arrays of a block [sample]; the .msg files say the same

NOT_SIGNALS = {"header", "run_id", "source", "__msgtype__"}  #: fields of sparse messages that digests leave out

Samples = npt.NDArray[Any]
Signals = dict[str, Samples]  #: the arrays of a block by field name


@cache
def _own() -> "Typesdict":
    """The types of lathe_rc."""
    found: Typesdict = {}
    for path in sorted((Path(__file__).with_name("msg_defs") / "msg").glob("*.msg")):
        found.update(get_types_from_msg(path.read_text(encoding="utf-8"), f"{PACKAGE}/msg/{path.stem}"))
    return found


@cache
def store() -> Typestore:
    """ROS 2's own types and those of lathe_rc; they take a while to load, and a run without a bag needs none."""
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(_own())
    return types


def fields(msgtype: str) -> list[tuple[str, Any]]:
    """Names and kinds of a type's fields, in order, as rosbags has them."""
    return list((_own() if msgtype in _own() else store().fielddefs)[msgtype][1])


def _with(field: str) -> frozenset[str]:
    """The types of lathe_rc that have a field."""
    return frozenset(name for name in _own() if any(field == given for given, _ in fields(name)))


@cache
def block_types() -> frozenset[str]:
    """Message types of topics that carry a block a block."""
    return _with("block")


@cache
def sparse_types() -> frozenset[str]:
    """Message types of topics that carry messages at chosen samples."""
    return _with("sample_index") | {JOINTS}


@cache
def signal_types() -> frozenset[str]:
    """Message types of all signal topics."""
    return block_types() | sparse_types()


@cache
def sample_fields(msgtype: str) -> dict[str, np.dtype[Any]]:
    """The array fields of a block type, in order, with their element types."""
    found = {}
    for name, (kind, detail) in fields(msgtype):
        if kind == Nodetype.SEQUENCE:
            ((_, (element, _)), _) = cast("tuple[tuple[Any, tuple[str, int]], int]", detail)
            found[name] = np.dtype(element)
    return found


def full(topic: str) -> str:
    """The fully qualified name of a topic; results of the engine come without the slash."""
    return "/" + topic.lstrip("/")


def allocate(msgtype: str, samples: int) -> Signals:
    """Zeroed arrays for ``samples`` samples of a block type."""
    return {name: np.zeros(samples, dtype) for name, dtype in sample_fields(msgtype).items()}


def header(index: int, step_ns: int) -> Any:
    """std_msgs/Header with the simulated time of sample ``index``."""
    seconds, nanoseconds = divmod(START_NS + index * step_ns, 1_000_000_000)
    types = store().types
    stamp = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    return types["std_msgs/msg/Header"](stamp, "")


def stamp_ns(message: Any) -> int:
    """Simulated time [ns] in a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_of(data: bytes | memoryview) -> int:
    """Simulated time [ns] of an encoded message whose first field is a header; nothing else of it is decoded."""
    stamp = decode("builtin_interfaces/msg/Time", bytes(data[:12]))  # the header's first field
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def encode(msgtype: str, message: Any) -> bytes:
    """CDR bytes of a message, padded to a multiple of four as DDS hands them over."""
    data = bytes(store().serialize_cdr(message, msgtype))
    return data + bytes(-len(data) % 4)


def values_of(msgtype: str, data: bytes) -> dict[str, Any]:
    """The fields of a message, without its header, sender and run.

    Raises:
        ValueError: the bytes are no such message.
    """
    return {name: value for name, value in vars(decode(msgtype, data)).items() if name not in NOT_SIGNALS}


def decode(msgtype: str, data: bytes) -> Any:
    """A message from CDR bytes; arrays are views of the bytes.

    Raises:
        ValueError: the bytes are no such message.
    """
    try:
        return store().deserialize_cdr(data, msgtype)
    except Exception as error:  # noqa: BLE001 - rosbags' generated code raises whatever broken bytes lead to
        raise ValueError(f"{msgtype} cannot be decoded ({type(error).__name__})") from None
