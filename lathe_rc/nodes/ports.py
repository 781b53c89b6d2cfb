# SPDX-License-Identifier: Apache-2.0
"""Classes of messages, and quality of service of the topics of a cell."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from lathe_rc import messages
from lathe_rc.cell.host_topics import signal_depth
from lathe_rc.cell.parameters import NodeParameters


def message_class(msgtype: str) -> Any:
    """The rclpy class of a message type. A bag or a topic names it: no package is imported but those of interfaces.

    Raises:
        ImportError: there is no such package of interfaces here.
        AttributeError: it has no such message.
        ValueError: that is no name of a type.
    """
    package, kind, name = msgtype.split("/")
    if package != messages.PACKAGE and not _holds_interfaces(package):
        raise ImportError(f"{package} is no package of interfaces here")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def _holds_interfaces(package: str) -> bool:
    """Tell whether a package was made of message definitions: only those have this type support beside them.

    ROS's own index of resources is not asked: in an environment of wheels nothing says where it is.
    """
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    folders = (spec.submodule_search_locations or ()) if spec else ()
    return any(any(Path(folder).glob(f"{package}_s__rosidl_typesupport_c*")) for folder in folders)


def signal_qos(parameters: NodeParameters, topic: str = "") -> QoSProfile:
    """Reliable, and deep enough for all blocks in flight, which a late match then still receives.

    A reader of a cell with a window keeps all until it takes them: a flood from outside would push out what belongs.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if topic and parameters.window else HistoryPolicy.KEEP_LAST,
        depth=signal_depth(parameters),
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE
        if topic in parameters.volatile_inputs
        else DurabilityPolicy.TRANSIENT_LOCAL,
    )


def latched_qos(depth: int = 0) -> QoSProfile:
    """Reliable; the newest message of each publisher reaches those who come late.

    Without a depth, for readers: all are kept until they are taken, a flood from outside pushes none out.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if depth else HistoryPolicy.KEEP_ALL,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )
