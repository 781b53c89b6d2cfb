# SPDX-License-Identifier: Apache-2.0
"""ROS graph and announcements: matched topics, and the actual parameters of the members."""

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.subscription import Subscription

from lathe_rc import allowed_code, resources
from lathe_rc.cell.beside import REPLAYED_FILES, REPLAYER
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.wiring import Unknown
from lathe_rc.errors import InputError, shown
from lathe_rc.nodes.taking import GID
from lathe_rc.protocol import Announcement, MemberProtocol
from lathe_rc.protocol.exchange import Exchange

_NOT_TOLD_YET = "_NODE_NAME_UNKNOWN_"  # name in the graph of a node whose name is not known yet

Announced = tuple[dict[str, NodeParameters], dict[str, Unknown]]


def publishers(node: Node, topic: str) -> list[str]:
    """Return the nodes that publish a topic."""
    return sorted(_name(end) for end in node.get_publishers_info_by_topic(topic))


def senders(node: Node, topic: str) -> dict[bytes, str]:
    """Return the names of the nodes that publish a topic, by the identity of their publishers.

    A replayer speaks for all nodes of its bag: its name is empty, as if it were not known.
    """
    ends = [end for end in node.get_publishers_info_by_topic(topic) if end.node_name != _NOT_TOLD_YET]
    return {bytes(end.endpoint_gid[:GID]): "" if end.node_name == REPLAYER else _name(end) for end in ends}


def unmatched(
    node: Node,
    inlets: Mapping[str, Subscription],
    outlets: Mapping[str, Publisher],
    protocol: MemberProtocol,
    exchange: Exchange,
) -> Iterator[str]:
    """Return the topics with missing peers, each with the members that have not matched yet.

    The ROS graph has names, but may list endpoints before DDS has matched them; DDS counts matches, but without names.

    Args:
        node: node that has the topics.
        inlets: subscriptions by fully qualified topic.
        outlets: publishers by fully qualified topic.
        protocol: protocol object with the known members.
        exchange: exchange with the readers in this process.
    """
    for topic, inlet in inlets.items():
        expected = protocol.expected_writers(topic)
        there = {_name(end) for end in node.get_publishers_info_by_topic(topic)}
        if not expected:
            yield f"{topic}, which no member publishes"
        elif not expected <= there or inlet.get_publisher_count() < len(expected):
            yield f"{topic} from {', '.join(sorted(expected - there or expected))}"
    for topic, outlet in outlets.items():
        expected = protocol.expected_readers(topic) - exchange.readers(topic)
        there = {_name(end) for end in node.get_subscriptions_info_by_topic(topic)}
        if not expected <= there or outlet.get_subscription_count() < len(expected):
            yield f"{topic} to {', '.join(sorted(expected - there or expected))}"


def unfit(node: Node, inlets: Mapping[str, Subscription]) -> Iterator[tuple[str, str, str]]:
    """Yield topic, node and reason of each publisher that DDS does not match with a subscription of the node.

    The graph is polled because events of DDS can deadlock a node: rmw_fastrtps 8.4 takes its own lock and then the lock
    of DDS, while DDS takes them in the opposite order (its pull request 890). So no node of a cell waits for events.
    Lost messages need none, since readers count every block and every message at a chosen sample.

    Args:
        node: node that has the topics.
        inlets: subscriptions by fully qualified topic.
    """
    for topic, inlet in inlets.items():
        for end in node.get_publishers_info_by_topic(topic):
            fits, why = qos_check_compatible(end.qos_profile, inlet.qos_profile)
            if fits == QoSCompatibility.ERROR and end.node_name != _NOT_TOLD_YET:
                yield topic, _name(end), "; ".join(part.removeprefix("ERROR: ") for part in why.split(";") if part)


def _name(end: Any) -> str:
    if end.node_name == _NOT_TOLD_YET:
        return "a node whose name DDS has not told yet"
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def announced(
    members: Mapping[str, Announcement],
    names: Sequence[str],
    namespace: str,
    report_unknown: Callable[[str, str, str], None],
) -> Announced:
    """Return the members' announcements by relative name, as input for a `lathe_rc.cell.wiring.Cell`.

    Args:
        members: all announcements received.
        names: names of the cell's members.
        namespace: namespace with a trailing slash.
        report_unknown: called with the name and the stage of a member of unknown kind, and the reason.

    Returns:
        The parameters of members of known kinds, and the topics of all other members.

    Raises:
        InputError: a member of a known kind has an invalid parameter.
    """
    tables, unknown = dict[str, NodeParameters](), dict[str, Unknown]()
    for name in names:
        table = _table(members[name], report_unknown)
        if table is None:
            unknown[name.removeprefix(namespace)] = _topics_of(members[name], namespace)
        else:
            tables[name.removeprefix(namespace)] = table
    return tables, unknown


def _topics_of(member: Announcement, namespace: str) -> Unknown:
    dense, sparse = dict[str, str](), dict[str, str]()
    for topic, msgtype, is_sparse in zip(member.publishes, member.types, member.sparse, strict=True):
        (sparse if is_sparse else dense)[topic.removeprefix(namespace)] = msgtype
    return Unknown(dense, sparse, frozenset(topic.removeprefix(namespace) for topic in member.subscribes))


def _table(member: Announcement, report_unknown: Callable[[str, str, str], None]) -> NodeParameters | None:
    """Return the announced parameters of a member; None, after a report, if its stage is unknown here."""
    try:
        kind = TABLES.get(member.stage)
        why = "there is no such stage here"
    except InputError as error:
        kind, why = None, str(error)
    if kind is not None:
        values = json.loads(member.parameters) | {"stage": member.stage}
        missing = [row for row in kind.rows() if row not in values]
        refused = "" if missing else _refused(kind, values)
        if not missing and not refused:
            return kind.read(member.name, values)
        others = f" and {len(missing) - 1} others" if missing[1:] else ""
        why = refused or f"its parameters do not say {missing[0]}{others}"
    report_unknown(member.name, member.stage, why)
    return None


def _refused(kind: type[NodeParameters], values: Mapping[str, object]) -> str:
    """Return the reason to reject announced parameters: they name code or files that a member may not name."""
    for row in kind.rows().values():
        value = values[row.name]
        if row.named is not None:
            registry = row.named.registry
            for name in row.named.others(value):
                if not registry.permits(name):
                    return f"{row.name} = {shown(repr(name))}: {registry.why_not(name)}"
        permits = allowed_code.is_named if row.name in allowed_code.FILES else _may_announce
        if row.is_file and value and not permits(str(value)):
            return f"{row.name} = {shown(repr(value))}: a file that no parameter file of this process names"
    return ""


def _may_announce(path: str) -> bool:
    """Return True if a member may name a file: a file of the user, of lathe_rc, or of a replayed bag."""
    if allowed_code.is_named(path):
        return True
    place, temporary = resources.find(Path(path)).resolve(), Path(tempfile.gettempdir()).resolve()
    replayed = any(each.parent == temporary and each.name.startswith(REPLAYED_FILES) for each in place.parents)
    return replayed or resources.is_own(place)
