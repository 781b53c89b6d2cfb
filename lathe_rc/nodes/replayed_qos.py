# SPDX-License-Identifier: Apache-2.0
"""Quality of service with which the topics of a bag are sent again."""

from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosReliability

DEPTH = 512  #: of the queues: so many may be under way before readers must have acknowledged


def _offers(recorded: Sequence[Qos]) -> set[tuple[bool, bool]]:
    """Whether the publishers of a topic were best effort, and latched; a replay promises no deadline or lease."""
    return {
        (each.reliability == QosReliability.BEST_EFFORT, each.durability == QosDurability.TRANSIENT_LOCAL)
        for each in recorded
    }


def differ(recorded: Sequence[Qos]) -> bool:
    """Whether the publishers of a topic offered what one publisher cannot."""
    return len(_offers(recorded)) > 1


def of(recorded: Sequence[Qos]) -> QoSProfile:
    """As the topic was offered; reliable and volatile if nothing is known, or its publishers differ, as in rosbag2."""
    offers = _offers(recorded)
    best_effort, latched = offers.pop() if len(offers) == 1 else (False, False)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def kept(recorded: Sequence[Qos]) -> int:
    """Messages that the publishers of a topic kept for late readers."""
    depths = (DEPTH if each.history == QosHistory.KEEP_ALL else max(each.depth, 1) for each in recorded)
    return min(sum(depths), DEPTH)
