# SPDX-License-Identifier: Apache-2.0
"""Publishers of arbitrary topics: installed message types and offered quality of service (QoS)."""

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosbags.interfaces import Nodetype, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lathe_rc.errors import InputError


@cache
def installed(msgtype: str) -> Typestore:
    """Return a message type and its nested types, as defined by the installed packages.

    Raises:
        InputError: a type is not installed.
    """
    found: dict[str, Any] = {}
    wanted = {msgtype}
    while wanted:
        name = wanted.pop()
        package, kind, short = name.split("/")
        try:
            path = Path(get_package_share_directory(package)) / kind / f"{short}.msg"
            found.update(get_types_from_msg(path.read_text(encoding="utf-8"), name))
        except (PackageNotFoundError, OSError, ValueError, TypesysError):
            raise InputError(f"message type {msgtype} is not installed; install its package") from None
        wanted |= {used for _, fields in found.values() for _, kind in fields for used in _used(kind)} - found.keys()
    store = get_typestore(Stores.EMPTY)
    store.register(found)
    return store


def _used(kind: Any) -> Iterable[str]:
    """Yield the message types in a field description."""
    if kind[0] == Nodetype.NAME:
        yield kind[1]
    elif kind[0] != Nodetype.BASE:
        yield from _used(kind[1][0])


def offered(publisher: TopicEndpointInfo) -> Qos:
    """Return the offered QoS of a publisher in the form used by bags; DDS transmits no history and depth."""
    qos = publisher.qos_profile
    deadline, lifespan, lease = (
        QosTime(*divmod(duration.nanoseconds, 10**9))
        for duration in (qos.deadline, qos.lifespan, qos.liveliness_lease_duration)
    )
    return Qos(
        QosHistory[qos.history.name],
        qos.depth,
        QosReliability[qos.reliability.name],
        QosDurability[qos.durability.name],
        deadline,
        lifespan,
        QosLiveliness[qos.liveliness.name],
        lease,
        avoid_ros_namespace_conventions=qos.avoid_ros_namespace_conventions,
    )


def offered_or(assumed: Qos, publishers: Iterable[TopicEndpointInfo]) -> Qos:
    """Return the first offered QoS that differs from an assumed one in what DDS transmits; else the assumed one."""
    found = (offered(publisher) for publisher in publishers)
    return next(
        (qos for qos in found if qos._replace(history=assumed.history, depth=assumed.depth) != assumed), assumed
    )


def asked(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the strictest QoS that all publishers offer; with a full queue, reliable publishers wait."""
    reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
