# SPDX-License-Identifier: Apache-2.0
"""Quality of service as the bags of all versions of ROS 2 write it; what a profile does not say is unknown."""

from collections.abc import Mapping
from enum import Enum
from functools import lru_cache
from typing import Any, TypeVar

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from lathe_rc.bag.reading.precheck import read_yaml

Kind = TypeVar("Kind", bound=Enum)


@lru_cache(maxsize=64)
def of_text(text: str) -> tuple[Qos, ...]:
    """Profiles of a topic's publishers from the text of a bag; most topics of a bag have the same.

    Raises:
        ValueError: no YAML, or one that would grow when it is read.
    """
    return of_list(read_yaml(text, "offered_qos_profiles"))


def of_list(given: object) -> tuple[Qos, ...]:
    """Profiles of a topic's publishers: a list of maps, or a map; no others."""
    listed = given if isinstance(given, list) else [given]
    return tuple(_profile(each) for each in listed if isinstance(each, dict))


def _profile(given: Mapping[str, object]) -> Qos:
    deadline, lifespan, lease = (
        QosTime(_number(part.get("sec")), _number(part.get("nsec"))) if isinstance(part, dict) else QosTime(0, 0)
        for part in map(given.get, ("deadline", "lifespan", "liveliness_lease_duration"))
    )
    return Qos(
        _choice(QosHistory, given.get("history")),
        _number(given.get("depth")),
        _choice(QosReliability, given.get("reliability")),
        _choice(QosDurability, given.get("durability")),
        deadline,
        lifespan,
        _choice(QosLiveliness, given.get("liveliness")),
        lease,
        avoid_ros_namespace_conventions=str(given.get("avoid_ros_namespace_conventions")).lower() == "true",
    )


def _choice(kind: type[Kind], given: object) -> Kind:
    """By number, as up to version 8 of the metadata, or by name."""
    unknown: Any = kind["UNKNOWN"]
    by_number = {str(each.value): each for each in kind}
    return by_number.get(str(given)) or kind.__members__.get(str(given).upper(), unknown)


def _number(given: object) -> int:
    """0: as if nothing had been said."""
    text = str(given)
    return int(text) if text.isascii() and text.isdigit() and len(text) <= len(str(2**64)) else 0
