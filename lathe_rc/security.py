# SPDX-License-Identifier: Apache-2.0
"""SROS2 policies: the topics and services that each node of a cell may use, derived from the wiring without ROS.

DDS security applies to processes, not to nodes: an enclave holds the permissions of one process, which are the union of
its nodes' profiles. No name is denied explicitly, since everything outside the profiles of an enclave is denied.
"""

import pkgutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lathe_rc import harness
from lathe_rc.catalogue import DRAWN
from lathe_rc.cell.beside import MACHINE_STATE, PANEL, PANEL_COMMANDS, REPLAYER, RERUN_BRIDGE, TOPIC_RECORDER
from lathe_rc.cell.host_topics import HOST_TOPICS, MASTER, MEMBER
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.recorder import KIND as RECORDER
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import ALIVE, SAFETY
from lathe_rc.names import absolute, checked_namespace
from lathe_rc.view.machine_state import source as machine_source

OPERATOR = "operator"  #: user of the ROS command-line tools, who may read every topic and call every service

_LOG, _PARAMETER_EVENTS, _CLOCK = "/rosout", "/parameter_events", "/clock"
_PARAMETERS = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
_LIFECYCLE = (
    "change_state",
    "get_available_states",
    "get_available_transitions",
    "get_state",
    "get_transition_graph",
)
_PLAYER = "burst get_rate is_paused pause play_next resume seek set_rate stop toggle_paused"
#: services of some kinds of nodes
_SERVICES = {RECORDER: ("snapshot",), REPLAYER: tuple(_PLAYER.split())}
_RECORDED = ("/diagnostics", "cell_state")  # host topics stored in a bag
_OF_A_SIMULATOR = ("get_simulation_state", "get_simulator_features", "set_simulation_state", "step_simulation")
_STEPS = "simulate_steps/_action"  # its services and topics
_OF_THE_MACHINE = {"joint_states", "wrench"}  # topics of the node machine_state
_COMMAND_LINE = "/_ros2cli_*/get_type_description"  # service of the nodes that the ros2 commands create


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Permissions of one node; names are relative to its namespace, or absolute if the whole domain shares them.

    Attributes:
        namespace: namespace of the node, ``/`` or ``/a/b``.
        node: name of the node.
        publish, subscribe: topics that the node publishes and subscribes to.
        reply, request: services that the node offers and calls.
    """

    namespace: str
    node: str
    publish: frozenset[str]
    subscribe: frozenset[str]
    reply: frozenset[str]
    request: frozenset[str] = frozenset()


Policy = dict[str, list[Profile]]  #: profiles of each enclave, by enclave path


class _Maker:
    """Builder of the profiles for the nodes of a cell and for the tools used alongside it.

    Args:
        scenario: scenario with a recorder.
        namespace: namespace of the cell.
    """

    def __init__(self, scenario: Scenario, namespace: str) -> None:
        self._scenario, self._namespace = scenario, namespace
        self._cell = Cell(scenario.nodes)
        self._signals = {**self._cell.dense, **self._cell.sparse}
        self.members: list[Profile] = []

    def member(self, name: str, group: Sequence[str]) -> Profile:
        """Return the profile of a node that shares a process with ``group`` and reads the group's topics in memory."""
        kind, stage = self._scenario.kind(name), self._cell.stages.get(name)
        own = {topic for topic, source in self._signals.items() if source.node == name}
        reads = {topic for topic in self._signals if stage is None or stage in self._cell.readers(topic)}
        inside = {topic for topic, source in self._signals.items() if source.node in group}
        services = [*_LIFECYCLE, *_SERVICES.get(kind, ()), *(["end"] if name in self._scenario.masters else [])]
        if stage:
            services.append("schedule")
        masters = set(self._scenario.masters)
        roles = {MEMBER, kind, *([MASTER] if name in masters else [])}
        told = {topic.name for topic in HOST_TOPICS if topic.publisher in roles}
        heard = {topic.name for topic in HOST_TOPICS if topic.subscriber in roles}
        watched = set(self._scenario.nodes) - masters if name in masters else masters
        heard |= {remapped(stage.shared, topic) for topic in stage.foreign} if stage else set()
        heard |= {f"{other}/{ALIVE}" for other in watched - set(group)}
        profile = self._node(
            name,
            publish=own | told | {f"{name}/transition_event", f"{name}/{ALIVE}"},
            subscribe=reads - inside | heard,
            services=services,
        )
        if getattr(self._scenario.nodes[name], "simulation_services", ""):
            steps = (f"{_STEPS}/{service}" for service in ("send_goal", "get_result", "cancel_goal"))
            reply = profile.reply.union(_OF_A_SIMULATOR, steps)
            profile = replace(
                profile, reply=reply, publish=profile.publish | {f"{_STEPS}/feedback", f"{_STEPS}/status"}
            )
        self.members.append(profile)
        return profile

    def _node(
        self,
        name: str,
        *,
        publish: Iterable[str] = (),
        subscribe: Iterable[str] = (),
        services: Iterable[str] = (),
        logs: bool = True,
    ) -> Profile:
        """Return a profile with the permissions common to all rclpy nodes and those in the arguments."""
        return Profile(
            namespace=self._namespace,
            node=name,
            publish=frozenset([*publish, _PARAMETER_EVENTS, *([_LOG] if logs else [])]),
            subscribe=frozenset(subscribe),
            reply=frozenset(f"{name}/{service}" for service in [*_PARAMETERS, *services]),
        )

    def rerun_bridge(self) -> Profile:
        """Return the profile of the Rerun bridge, which reads the signals shown in a scene and the cell's state."""
        is_drawn = pkgutil.resolve_name(DRAWN)
        drawn = [topic for topic, source in self._signals.items() if is_drawn(source.type)]
        return self._node(RERUN_BRIDGE, subscribe=[*drawn, "cell_state"])

    def panel(self) -> Profile:
        """Return the profile of an attached panel, which reads the signals of the Rerun bridge and the cell's state."""
        bridge = self.rerun_bridge()
        states = {topic for topic, source in self._signals.items() if source.type == SAFETY} | {"cell_state"}
        reply = frozenset(f"{PANEL}/{each}" for each in _PARAMETERS)
        return replace(bridge, node=PANEL, subscribe=bridge.subscribe | states, reply=reply)

    def panel_commands(self) -> Profile:
        """Return the profile of its second node, which asks for events, pace and pause."""
        (master,) = self._scenario.masters
        asked = {f"{name}/schedule" for name in self._cell.stages} | {f"{master}/set_parameters"}
        if self._cell.master.parameters.simulation_services:
            asked.add("set_simulation_state")
        return replace(self._node(PANEL_COMMANDS), request=frozenset(asked))

    def machine_state(self) -> Profile:
        """Return the profile of the publisher of standard messages, which reads joints and force of the machine."""
        heard = [topic for topic, origin in self._signals.items() if machine_source(topic, origin.type)]
        return self._node(MACHINE_STATE, publish=_OF_THE_MACHINE, subscribe=heard, logs=False)

    def replayer(self) -> Profile:
        """Return the profile of the replayer, the only publisher of a recorded cell's topics."""
        topics = [*self._signals, *_RECORDED, _CLOCK]
        return self._node(REPLAYER, publish=topics, services=_SERVICES[REPLAYER], logs=False)

    def topic_recorder(self) -> Profile:
        """Return the profile of the topic recorder, which reads every topic of the cell and of its machine."""
        topics = (self._published() | _OF_THE_MACHINE) - {_LOG, _PARAMETER_EVENTS}
        return self._node(TOPIC_RECORDER, subscribe=topics, logs=False)

    def operator(self) -> Profile:
        """Return the profile for the ROS command-line tools, which generate their own node names."""
        return Profile(
            namespace=self._namespace,
            node=OPERATOR,
            publish=frozenset([_LOG, _PARAMETER_EVENTS]),
            subscribe=self._published(),
            reply=frozenset([_COMMAND_LINE]),
            request=frozenset(service for profile in self.members for service in profile.reply),
        )

    def _published(self) -> frozenset[str]:
        return frozenset(topic for profile in self.members for topic in profile.publish)


_BESIDE: Mapping[str, Sequence[Callable[[_Maker], Profile]]] = {
    OPERATOR: [_Maker.operator],
    REPLAYER: [_Maker.replayer],
    RERUN_BRIDGE: [_Maker.rerun_bridge],
    PANEL: [_Maker.panel, _Maker.panel_commands],
    TOPIC_RECORDER: [_Maker.topic_recorder],
    MACHINE_STATE: [_Maker.machine_state],
}
BESIDE = tuple(_BESIDE)  #: tools that can be given permissions in addition to the members of a cell


def policy(
    scenario: Scenario,
    *,
    groups: Sequence[Sequence[str]] | None = None,
    namespace: str = "/",
    beside: Iterable[str] = (),
) -> Policy:
    """Return the permissions of a scenario's processes.

    Args:
        scenario: the scenario; a recorder is added if it has none.
        groups: groups of nodes that share a process; every other node has its own; None: as in the scenario.
        namespace: namespace of the cell, ``/`` or ``/a/b``.
        beside: additional tools that are given permissions, from `BESIDE`.

    Returns:
        The profiles of each enclave. An enclave's path is the fully qualified name of the first node in its process.

    Raises:
        InputError: the scenario cannot be wired, ``groups`` names an unknown node, or the namespace is invalid.
    """
    checked_namespace(namespace)
    # The bag's folder does not affect the policy.
    complete = harness.with_recorder(scenario, Path(RECORDER), keep=True)
    maker = _Maker(complete, namespace)
    made = {
        absolute(namespace, group[0]): [maker.member(name, group) for name in group]
        for group in complete.processes(groups)
    }
    return made | {absolute(namespace, kind): [make(maker) for make in _BESIDE[kind]] for kind in dict.fromkeys(beside)}


def to_xml(made: Policy, title: str) -> str:
    """Return the policy as SROS2 XML, version 0.2.0, with ``title`` as its heading."""
    root = ET.Element("policy", version="0.2.0")
    enclaves = ET.SubElement(root, "enclaves")
    for path, profiles in made.items():
        inner = ET.SubElement(ET.SubElement(enclaves, "enclave", path=path), "profiles")
        for profile in profiles:
            _append(ET.SubElement(inner, "profile", ns=profile.namespace, node=profile.node), profile)
    ET.indent(root)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<!-- SPDX-License-Identifier: Apache-2.0
     SROS2 policy of {title}, made by `lathe policy` (docs/security.md).
     An enclave is a process; what is not allowed here is denied. -->
{ET.tostring(root, encoding="unicode")}
"""


def _append(element: ET.Element, profile: Profile) -> None:
    for kind, rules in (
        ("service", {"reply": profile.reply, "request": profile.request}),
        ("topic", {"publish": profile.publish, "subscribe": profile.subscribe}),
    ):
        for rule, names in rules.items():
            if names:
                allowed = ET.SubElement(element, f"{kind}s", {rule: "ALLOW"})
                for text in sorted(_expression(profile, name) for name in names):
                    ET.SubElement(allowed, kind).text = text


def _expression(profile: Profile, name: str) -> str:
    """Return a name in policy notation, where ~ stands for the node's own name."""
    own = f"{profile.node}/"
    return f"~/{name.removeprefix(own)}" if name.startswith(own) else name
