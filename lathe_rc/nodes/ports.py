# SPDX-License-Identifier: Apache-2.0
"""ROS message classes, quality of service (QoS) of a cell's topics, and messages taken without an executor."""

import importlib
import importlib.util
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from lathe_rc import messages
from lathe_rc.blocks.ports import signal_depth
from lathe_rc.cell.parameters import NodeParameters


def message_class(msgtype: str) -> Any:
    """Return the rclpy class of a message type; of foreign names, only interface packages are imported.

    Raises:
        ImportError: no such interface package is installed.
        AttributeError: the package has no such message.
        ValueError: not the name of a message type.
    """
    package, kind, name = msgtype.split("/")
    if package != messages.PACKAGE and not _holds_interfaces(package):
        raise ImportError(f"{package} is no package of interfaces here")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def _holds_interfaces(package: str) -> bool:
    """Return True if a package contains interfaces: only these packages have the type support library.

    ROS's resource index is not used: an environment of wheels does not tell where it is.
    """
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    folders = (spec.submodule_search_locations or ()) if spec else ()
    return any(any(Path(folder).glob(f"{package}_s__rosidl_typesupport_c*")) for folder in folders)


def signal_qos(parameters: NodeParameters, topic: str = "") -> QoSProfile:
    """Return the QoS of signal topics: reliable, and deep enough that a late match receives all blocks in flight.

    A reader in a cell with a window keeps all messages until it takes them: otherwise a flood of foreign messages could
    displace the cell's own.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if topic and parameters.window else HistoryPolicy.KEEP_LAST,
        depth=signal_depth(parameters.window),
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE
        if topic in parameters.volatile_inputs
        else DurabilityPolicy.TRANSIENT_LOCAL,
    )


def latched_qos(depth: int = 0) -> QoSProfile:
    """Return the QoS of latched topics: reliable; late readers receive the newest message of each publisher.

    Without a depth, for readers: all messages are kept until they are taken, so a flood of foreign ones displaces none.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if depth else HistoryPolicy.KEEP_ALL,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def overhear(node: Node, topic: str, msgtype: str, depth: int) -> Subscription:
    """Subscribe to encoded messages (see `taken`) so that no publisher waits: best effort and volatile."""
    qos = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )
    return node.create_subscription(message_class(msgtype), topic, lambda _: None, qos, raw=True)


def taken(inlet: Subscription, most: int) -> Iterator[tuple[Any, Any]]:
    """Take at most some of the received messages without an executor; yield each with its information."""
    with inlet.handle:
        take = partial(inlet.handle.take_message, inlet.msg_type, inlet.raw)
        yield from islice(iter(take, None), most)
