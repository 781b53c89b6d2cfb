# SPDX-License-Identifier: Apache-2.0
"""Quality of service (QoS) of replayed topics."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosReliability

from lathe_rc.bag.reading.metadata import read_yaml
from lathe_rc.errors import InputError, shown
from lathe_rc.names import instead

DEPTH = 512  #: of the queues: largest number of unacknowledged messages
_ALLOWED = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort"),
    "durability": ("volatile", "transient_local"),
}


def overrides(path: Path, topics: Collection[str]) -> dict[str, dict[str, str]]:
    """Read a file of QoS overrides as for ``ros2 bag play``: policies by topic.

    Raises:
        InputError: not such a file; a topic, policy or value is unknown.
    """
    try:
        tree = read_yaml(path.read_text(encoding="utf-8"), path.name)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {shown(error)}; allowed: a YAML file of topics with their policies") from None
    found = tree if isinstance(tree, dict) else {"": tree}
    for topic, policies in found.items():
        if topic not in topics:
            raise InputError(f"{path}: topic {shown(topic)!r} is not replayed; {instead(topic, sorted(topics))}")
        for policy, value in policies.items() if isinstance(policies, dict) else [(policies, "")]:
            allowed = ", ".join(_ALLOWED.get(policy, ()))
            if policy not in (*_ALLOWED, "depth"):
                raise InputError(
                    f"{path}: {topic}: policy {shown(policy)!r}; allowed: history, depth, reliability, durability"
                )
            if policy == "depth" and not (str(value).isdecimal() and 0 < int(value) < 2**31):
                raise InputError(f"{path}: {topic}: depth {shown(value)!r}; allowed: a whole number from 1 on")
            if allowed and value not in _ALLOWED[policy]:
                raise InputError(f"{path}: {topic}: {policy} {shown(value)!r}; allowed: {allowed}")
    return found


def _latched(each: Qos) -> bool:
    return each.durability == QosDurability.TRANSIENT_LOCAL


def of(recorded: Sequence[Qos], override: Mapping[str, str] | None = None) -> QoSProfile:
    """Return the QoS of a replayed topic, which serves the readers of all its recorded publishers.

    Reliable unless all were best effort, latched if one was. A replay offers no deadline, lifespan or lease.

    Args:
        recorded: QoS that the publishers offered.
        override: policies to offer instead (see `overrides`).
    """
    best_effort = bool(recorded) and all(each.reliability == QosReliability.BEST_EFFORT for each in recorded)
    policies = {
        "history": "keep_last",
        "depth": str(DEPTH),
        "reliability": "best_effort" if best_effort else "reliable",
        "durability": "transient_local" if any(map(_latched, recorded)) else "volatile",
        **(override or {}),
    }
    return QoSProfile(
        history=HistoryPolicy.get_from_short_key(policies["history"]),
        depth=int(policies["depth"]),
        reliability=ReliabilityPolicy.get_from_short_key(policies["reliability"]),
        durability=DurabilityPolicy.get_from_short_key(policies["durability"]),
    )


def kept(recorded: Sequence[Qos]) -> int:
    """Return the number of messages that the publishers of a topic kept for late readers."""
    depths = (
        DEPTH if each.history == QosHistory.KEEP_ALL else max(each.depth, 1) for each in recorded if _latched(each)
    )
    return min(max(sum(depths), 1), DEPTH)
