# SPDX-License-Identifier: Apache-2.0
"""Quality of service (QoS) of replayed topics."""

from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosReliability

DEPTH = 512  #: of the queues: largest number of unacknowledged messages


def _offers(recorded: Sequence[Qos]) -> set[tuple[bool, bool]]:
    """Return best-effort and latched flags of a topic's publishers; a replay offers no deadline or lease."""
    return {
        (each.reliability == QosReliability.BEST_EFFORT, each.durability == QosDurability.TRANSIENT_LOCAL)
        for each in recorded
    }


def differ(recorded: Sequence[Qos]) -> bool:
    """Return True if the publishers of a topic offered different QoS, which one publisher cannot reproduce."""
    return len(_offers(recorded)) > 1


def of(recorded: Sequence[Qos]) -> QoSProfile:
    """Return the offered QoS of a topic; reliable and volatile if unknown or not the same for all, as in rosbag2."""
    offers = _offers(recorded)
    best_effort, latched = offers.pop() if len(offers) == 1 else (False, False)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def kept(recorded: Sequence[Qos]) -> int:
    """Return the number of messages that the publishers of a topic kept for late readers."""
    depths = (DEPTH if each.history == QosHistory.KEEP_ALL else max(each.depth, 1) for each in recorded)
    return min(sum(depths), DEPTH)
