# SPDX-License-Identifier: Apache-2.0
"""Membership of a cell: what a node announces, whom it has heard of, and whether all topics have met.

The time master names the members; each announces who it is and how far it has come (the message ``Member``).
"""

import json
import os
import tempfile
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lathe_rc_msgs.msg import CellState, Member
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from lathe_rc import allowed_code, messages, resources
from lathe_rc.cell.beside import REPLAYED_FILES
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stages import MASTERS
from lathe_rc.cell.wiring import Unknown
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.nodes.exchange import Exchange
from lathe_rc.nodes.lifecycle import Lifecycle
from lathe_rc.nodes.liveliness import this_host
from lathe_rc.nodes.refused_messages import ForeignMessage

_NOT_TOLD_YET = "_NODE_NAME_UNKNOWN_"  # what the graph calls a node whose name has not come


class Membership(Lifecycle):
    """A node that announces itself, and knows the members of its cell by their announcements.

    Attributes:
        kind: what it is.
        table: its parameters, once configured.
        full_name: fully qualified.
        members: the newest announcement of each, by fully qualified name.
        master: that of the time master; None as long as it has not been heard.
        failure: why it gave up.
        done: it may leave: in a cell, all have finished their parts, also if it has given up its own.
        exchange: what the nodes of this process hand over in memory.
        outlets, inlets: publisher and subscription of each signal topic, by fully qualified name.
    """

    kind: str
    table: NodeParameters
    full_name: str
    members: dict[str, Member]
    master: Member | None
    failure: LatheError | None
    done: bool
    exchange: Exchange
    outlets: dict[str, Publisher]
    inlets: dict[str, Subscription]
    _ready: bool
    _safe: bool
    _cell: int | None  # what the time master has said
    _host: dict[str, Publisher]
    _told_unknown: set[str]

    @abstractmethod
    def publications(self) -> list[tuple[str, str, bool]]:
        """Fully qualified signal topic, message type, sparse or not."""

    @abstractmethod
    def subscriptions_wanted(self) -> list[str]:
        """Fully qualified signal topics."""

    def topic(self, relative: str) -> str:
        """Fully qualified name of a relative topic after all remapping."""
        return str(self.resolve_topic_name(remapped(self.table, relative)))

    def announce(self) -> None:
        """Publish who this is and how far it has come."""
        published = self.publications()
        own = Member(
            run_id=self.table.run_id,
            name=self.full_name,
            stage=self.kind,
            state=self._membership(),
            members=self.member_names(),
            publishes=[topic for topic, _, _ in published],
            types=[msgtype for _, msgtype, _ in published],
            sparse=[sparse for _, _, sparse in published],
            subscribes=self.subscriptions_wanted(),
            parameters=self._effective().model_dump_json(),
            message=str(self.failure or ""),
            host=this_host(),
            pid=os.getpid(),
        )
        self._host["members"].publish(own)

    def _membership(self) -> int:
        if self.failure:
            return int(Member.FAILED)
        if self._safe:
            return int(Member.SAFE)
        if self._ready:
            return int(Member.READY)
        return int(Member.WIRED if self.wired() else Member.JOINING)

    def wired(self) -> bool:
        """Whether all its publishers and subscriptions are there."""
        return True

    def _effective(self) -> NodeParameters:
        """The table with the remapping of the command line written into ``remap``."""
        namespace = self.get_namespace().rstrip("/") + "/"
        rules = [f"{topic}:={self.topic(topic).removeprefix(namespace)}" for topic in self.relative_topics()]
        changed = sorted({rule for rule in rules if rule.split(":=")[0] != rule.split(":=")[1]})
        return self.table.model_copy(update={"remap": changed})

    def announced(self, names: Iterable[str]) -> tuple[dict[str, NodeParameters], dict[str, Unknown]]:
        """The members' announcements, by their name in this node's namespace: for a `lathe_rc.cell.wiring.Cell`.

        Returns:
            The parameters of those that are known here, and the topics of those of whom nobody here knows more.

        Raises:
            InputError: a member that is known has a parameter that cannot be.
        """
        tables, unknown = dict[str, NodeParameters](), dict[str, Unknown]()
        for name in names:
            table = self._table(name)
            if table is None:
                unknown[self._relative(name)] = self._topics_of(self.members[name])
            else:
                tables[self._relative(name)] = table
        return tables, unknown

    def _topics_of(self, member: Member) -> Unknown:
        dense, sparse = dict[str, str](), dict[str, str]()
        for topic, msgtype, is_sparse in zip(member.publishes, member.types, member.sparse, strict=True):
            (sparse if is_sparse else dense)[self._relative(topic)] = msgtype
        return Unknown(dense, sparse, frozenset(self._relative(topic) for topic in member.subscribes))

    def _relative(self, name: str) -> str:
        """The name of a member or topic in this node's namespace."""
        return name.removeprefix(self.get_namespace().rstrip("/") + "/")

    def _table(self, name: str) -> NodeParameters | None:
        """The parameters that a member has announced; None, and reported once, if its stage is unknown here."""
        member = self.members[name]
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
                return kind.read(name, values)
            why = refused or f"its parameters do not say {missing[0]}" + (
                f" and {len(missing) - 1} others" if missing[1:] else ""
            )
        if name not in self._told_unknown:
            self._told_unknown.add(name)
            self.get_logger().info(f"{name}, stage {shown(repr(member.stage))}, is known by its topics alone: {why}")
        return None

    def relative_topics(self) -> list[str]:
        """Signal topics of the stage that it runs, before remapping, if it runs one."""
        return []

    def member_names(self) -> list[str]:
        """Fully qualified names of all members; only the time master knows them."""
        return []

    def _check_member(self, member: Member) -> None:
        """Refuse who is no member of this cell."""
        why = ""
        if self.table.run_id and member.run_id != self.table.run_id:
            why = f"expected run {self.table.run_id!r}"
        elif member.members and member.stage not in MASTERS:
            why = f"a time master is a {' or '.join(MASTERS)}"
        elif member.members and self.master is not None and member.name != self.master.name:
            why = f"the time master is {self.master.name}"
        elif not len(member.publishes) == len(member.types) == len(member.sparse):
            why = "its topics, their types and what is sparse are lists of different lengths"
        elif unknown := set(member.types) - messages.signal_types():
            why = f"no signals are of type {min(unknown)}"
        else:
            try:
                why = "" if isinstance(json.loads(member.parameters), dict) else "its parameters are no map"
            except (ValueError, RecursionError):
                why = "its parameters are no JSON"
        if why:
            raise ForeignMessage(self._host["members"].topic_name, member.name, member.run_id, why)

    def _parameter(self, name: str, key: str) -> object:
        """A parameter that a member has announced; None if it has no such."""
        return json.loads(self.members[name].parameters).get(key)

    def restarts(self, name: str) -> bool:
        """Whether another process may go on in place of a member."""
        return bool(self._parameter(name, "restart_file"))

    @property
    def complete(self) -> bool:
        """Whether the master and all members that it names have announced themselves."""
        return self.master is not None and all(name in self.members for name in self.master.members)

    def matched(self) -> bool:
        """Whether each input has met its publisher and each output the members that read it, by name and in fact.

        The graph knows names, but runs ahead of what DDS has matched; DDS counts matches, but without names.
        """
        return next(self._unmatched(), None) is None

    def _unmatched(self) -> Iterator[str]:
        """The topics that have not met, and whom they lack."""
        assert self.master is not None
        peers = [self.members[name] for name in self.master.members if name != self.full_name]
        for topic, inlet in self.inlets.items():
            expected = {peer.name for peer in peers if topic in peer.publishes}
            found = _names(self.get_publishers_info_by_topic(topic))
            if not expected:
                yield f"{topic}, which no member publishes"
            elif not expected <= found or inlet.get_publisher_count() < len(expected):
                yield f"{topic} from {', '.join(sorted(expected - found or expected))}"
        for topic, outlet in self.outlets.items():
            expected = {peer.name for peer in peers if topic in peer.subscribes} - self.exchange.readers(topic)
            found = _names(self.get_subscriptions_info_by_topic(topic))
            if not expected <= found or outlet.get_subscription_count() < len(expected):
                yield f"{topic} to {', '.join(sorted(expected - found or expected))}"

    def missing(self) -> list[str]:
        """Members and topics that it waits for until it can begin; empty if it has begun, or waits for nobody."""
        if self.done or self.failure or (self._ready and self._cell not in (None, CellState.WAITING)):
            return []
        if not self.active:
            return ["its own activation"]
        if self.master is None:
            lonely = [topic for topic, inlet in self.inlets.items() if not inlet.get_publisher_count()]
            alone = any(member.stage in MASTERS for member in self.members.values())
            master = [] if alone or not lonely else ["a time master"]
            return [*master, *(f"a publisher of {topic}" for topic in lonely)]
        others = [name for name in self.master.members if name != self.full_name]
        states = {name: self.members[name].state if name in self.members else None for name in others}
        unheard = [name for name, state in states.items() if state is None]
        joining = [f"{name} to join" for name, state in states.items() if state == Member.JOINING]
        if unheard or joining:
            return [*unheard, *joining]
        if not self._ready:
            return list(self._unmatched())
        return [f"{name} to be ready" for name, state in states.items() if state == Member.WIRED]

    def _who_publishes(self, topic: str) -> list[str]:
        """Nodes that publish a topic, as the graph lists them."""
        return sorted(_name(end) for end in self.get_publishers_info_by_topic(topic))


def _refused(kind: type[NodeParameters], values: Mapping[str, object]) -> str:
    """Why the parameters that a member announces are not taken: they name code or files that it may not name."""
    for row in kind.rows().values():
        value = values[row.name]
        if row.named is not None:
            registry = row.named.registry
            for name in row.named.others(value):
                if not registry.permits(name):
                    return f"{row.name} = {shown(repr(name))}: {registry.why_not(name)}"
        if row.is_file and value and not _may_announce(str(value)):
            return f"{row.name} = {shown(repr(value))}: a file that no parameter file of this process names"
    return ""


def _may_announce(path: str) -> bool:
    """Whether a member may name a file: as the user does, one that comes with lathe_rc, or one of a bag's replay."""
    if allowed_code.is_named(path):
        return True
    place, temporary = resources.find(Path(path)).resolve(), Path(tempfile.gettempdir()).resolve()
    replayed = any(each.parent == temporary and each.name.startswith(REPLAYED_FILES) for each in place.parents)
    return replayed or resources.is_own(place)


def _names(endpoints: list[Any]) -> set[str]:
    return {_name(end) for end in endpoints}


def _name(end: Any) -> str:
    if end.node_name == _NOT_TOLD_YET:
        return "a node whose name DDS has not told yet"
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"
