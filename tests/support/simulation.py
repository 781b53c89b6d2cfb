# SPDX-License-Identifier: Apache-2.0
"""Simulated cells: the shipped hosts, roles, queues and restart, a network and a clock in one thread, from one seed.

What is around the protocol is simulated: the steps of the stages, DDS with its graph and its liveliness, processes and
machines. Of the recorder only the reading: its bag is the list of the blocks read. tests/support/schedules.py draws the
cells.
"""

import heapq
import json
import random
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from lathe_machine.stages.tool.tool import ToolParameters
from lathe_rc import messages
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import Input
from lathe_rc.blocks.wire import Encoder
from lathe_rc.errors import LatheError
from lathe_rc.protocol import (
    Announcement,
    ForeignMessage,
    MemberProtocol,
    Pace,
    Phase,
    Reactions,
    TimeMasterProtocol,
    actions,
)
from lathe_rc.protocol.block_queue import BlockQueue
from lathe_rc.protocol.exchange import Exchange, JoinedBlocks
from lathe_rc.protocol.inputs import Inputs
from lathe_rc.protocol.leading_run import LeadingRun
from lathe_rc.protocol.member_host import MemberHost
from lathe_rc.protocol.restart import Restart
from lathe_rc.protocol.stage_run import StageRun

SIZE = 4  # samples in a block
LEASE = 0.08  # [s] of DDS's liveliness
RESTART_TIME = 1.0  # [s] that the cell waits for another process of a member
HORIZON = 60.0  # [s] of simulated wall time after which a member that is still there hangs


STEP_NS = 15_625
SPOILED = {  #: what may be wrong with a block
    "gap": lambda block: _shifted(block, SIZE),
    "repeat": lambda block: _shifted(block, -SIZE),
    "half a repeat": lambda block: _shifted(block, -SIZE // 2),
    "far away": lambda block: _shifted(block, 2**40),
    "short": lambda block: replace(block, samples=SIZE - 1, log_ns=block.log_ns - STEP_NS),
    "long": lambda block: replace(block, samples=SIZE + 1, log_ns=block.log_ns + STEP_NS),
    "step": lambda block: replace(block, step_ns=STEP_NS + 1),
    "stamp": lambda block: replace(block, log_ns=block.log_ns + 1),
    "last": lambda block: replace(block, last=not block.last),
    "another source": lambda block: replace(block, source="/ghost"),
    "number": lambda block: replace(block, signals={"position": np.full(SIZE, np.nan)}),  # in bytes alone
    "no block": lambda block: replace(block, samples=0),  # in bytes alone
}


def _shifted(block: Block, samples: int) -> Block:
    return replace(block, first_index=block.first_index + samples, log_ns=block.log_ns + samples * STEP_NS)


@cache
def table_of(run_id: str, window: int) -> ToolParameters:
    """Return the parameters of a simulated member."""
    return ToolParameters(run_id=run_id, window=window, block_size=SIZE)


@cache
def encoder_of(run_id: str, source: str, step_ns: int) -> Encoder:
    """Return the encoder of a member's blocks."""
    return Encoder(messages.COMMAND, run_id, source, step_ns)


def mixed(*parts: object) -> int:
    """Return a number that depends on all parts, and that a sample can hold."""
    return hash(parts) & (2**52 - 1)


@dataclass(frozen=True)
class Design:
    """Member of the cell in the scenario.

    Attributes:
        name: fully qualified name, also of the published topic.
        inputs: name of each publisher that the member reads, and the delay in blocks.
        restarts: the member can be restarted in another process.
    """

    name: str
    inputs: tuple[tuple[str, int], ...] = ()
    restarts: bool = False

    @property
    def records(self) -> bool:
        """Return True for the recorder, which publishes nothing."""
        return self.name == "/recorder"


def safe_value(name: str) -> int:
    """Return what a member computes in the safe state, whatever its inputs: its safe position."""
    return mixed(name, "safe")


class Network:
    """Reliable channels between members: in order on each topic, in any order across topics."""

    def __init__(self, cell: "Simulation") -> None:
        self._cell = cell
        self._history: dict[tuple[str, str], deque[object]] = {}  # newest messages by member and topic
        self._matched: set[tuple[str, str, str]] = set()  # writing member, reading member, topic
        self._newest: dict[tuple[str, str, str], float] = {}  # arrival of the last message
        self._cut: dict[frozenset[str], float] = {}  # end of the interruption by pair of members

    def advertise(self, writer: str, topic: str, depth: int) -> None:
        self._history.setdefault((writer, topic), deque(maxlen=depth))

    def match(self, writer: str, reader: str, topic: str) -> None:
        """Match a reader with a writer: it receives the newest messages, and all later ones."""
        if (writer, topic) in self._history and (writer, reader, topic) not in self._matched:
            self._matched.add((writer, reader, topic))
            for message in self._history[writer, topic]:
                self._send(writer, reader, topic, message)

    def is_matched(self, writer: str, reader: str, topic: str) -> bool:
        return (writer, reader, topic) in self._matched

    def publish(self, writer: str, topic: str, message: object) -> None:
        if writer not in self._cell.members:
            return  # it has ended
        self._history[writer, topic].append(message)
        for reader in self._cell.members:
            if (writer, reader, topic) in self._matched:
                self._send(writer, reader, topic, message)

    def _send(self, writer: str, reader: str, topic: str, message: object) -> None:
        cell, channel = self._cell, (writer, reader, topic)
        if cell.loses and isinstance(message, Block) and cell.random.random() < cell.share_lost(message, topic, reader):
            return
        begin = max(cell.now, self._cut.get(frozenset((writer, reader)), 0.0))
        arrival = max(begin + cell.delay(), self._newest.get(channel, 0.0))
        self._newest[channel] = arrival
        cell.at(arrival, partial(self._arrive, channel, message))

    def _arrive(self, channel: tuple[str, str, str], message: object) -> None:
        writer, reader, topic = channel
        if channel in self._matched and reader in self._cell.members:
            self._cell.members[reader].take(topic, message, writer.partition(" ")[0])

    def is_cut(self) -> bool:
        return any(until > self._cell.now for until in self._cut.values())

    def cut(self, one: str, other: str, until: float) -> None:
        self._cut[frozenset((one, other))] = until

    def heard_until(self, one: str, other: str) -> float:
        return self._cut.get(frozenset((one, other)), 0.0)

    def acknowledged(self, writer: str) -> float:
        """Return the arrival time of the last message of a member [s]."""
        return max((time for channel, time in self._newest.items() if channel[0] == writer), default=0.0)

    def forget(self, member: str, *, killed: bool) -> None:
        """Remove an ended member: messages in transit may be lost if it was killed or is cut off: none is repeated."""
        self._history = {key: queue for key, queue in self._history.items() if key[0] != member}
        late = self._cell.now + (0.0 if killed else 0.02)
        for key in sorted(key for key in self._matched if member in key[:2]):  # the order of a set differs by process
            if key[1] == member or (self._newest.get(key, 0.0) > late and self._cell.random.random() < 0.5):
                self._matched.remove(key)


class Process:
    """Process with one or several members: its loop is `lathe_rc.nodes.process._loop`."""

    def __init__(self, cell: "Simulation", designs: Sequence[Design], pid: int, host: str) -> None:
        self.cell, self.pid, self.host, self.exchange = cell, pid, host, Exchange()
        self.stopped = False
        self.free_at, self.cost = 0.0, 0.0  # end of the computation, and its time per message [s]
        self._inbox: deque[Callable[[], None]] = deque()
        self._waits = self._turns = False
        self._tick_at = np.inf
        self.members = [Member(self, design) for design in designs]

    @property
    def alive(self) -> bool:
        return self.members[0].alive

    def start(self) -> None:
        """Configure all nodes, then activate them."""
        for member in self.members:
            self.exchange.join(member.protocol.own.publishes)
        for member in self.members:
            member.activate()
        self.turn()

    def take(self, call: Callable[[], None]) -> None:
        """Process a message now, or when the process is free."""
        self._inbox.append(call)
        self.wake()

    def wake(self) -> None:
        """Process the waiting messages one after the other, when the process is free."""
        if self._waits or self.stopped or not self._inbox:
            return
        if self.free_at > self.cell.now:
            self._waits = True
            self.cell.at(self.free_at, self._handle)
        else:
            self._handle()

    def _handle(self) -> None:
        self._waits = False
        if self.stopped or not self.alive or not self._inbox:
            return
        self.free_at = self.cell.now + self.cost
        self._inbox.popleft()()
        self.turn()
        self.wake()

    def block_until(self, time: float) -> None:
        """Do nothing until a time."""
        self.free_at = max(self.free_at, time)
        self.cell.at(self.free_at, self.turn)

    def turn(self) -> None:
        """Let the nodes compute until none has new input, and end the process with its nodes."""
        if self._turns or not self.alive or self.stopped:
            return
        self._turns = True
        while waiting := [member for member in self.members if member.due]:
            for member in waiting:
                member.due = False
                member.work()
        self._turns = False
        states = [member.protocol for member in self.members]
        if all(each.done for each in states) or any(each.failure and not each.others_go_on for each in states):
            if self.cell.now >= self.free_at:
                self.cell.leave(self)
            else:
                self.cell.at(self.free_at, self.turn)
            return
        due = max(self.cell.now, min(member.next_tick for member in self.members if not member.protocol.done))
        if due < self._tick_at:
            self._tick_at = due
            self.cell.at(due, partial(self._tick, due))

    def _tick(self, due: float) -> None:
        if not self.alive or self.stopped or due != self._tick_at:
            return
        self._tick_at = np.inf
        for member in self.members:
            if self.cell.now >= member.next_tick and not member.protocol.done:
                member.tick(self.cell.now)
        self.turn()

    def resume(self) -> None:
        """Go on after a stop."""
        self.stopped, self._tick_at = False, np.inf
        if self.alive:
            self.turn()
            self.wake()

    def end_by(self, signal: str) -> None:
        """Handle SIGINT or SIGTERM."""
        for member in self.members:
            member.attempt(member.protocol.end_by, signal, self.cell.now)
        self.turn()


class Member(MemberHost):
    """Node of a member: `lathe_rc.nodes.cell_node.CellNode` without ROS."""

    role: "Stage"

    def __init__(self, process: Process, design: Design) -> None:
        self.process, self.cell, self.design = process, process.cell, design
        self.full_name, self.exchange = design.name, process.exchange
        self.identity = f"{design.name} {process.pid}"
        self.dawdles = 0.0  # time that the begin of the safe state takes [s]
        self.spoils = 0  # place of what is wrong with the next block; 0: nothing is
        self.strangers = 0
        self.namesake = False  # a second node with this name
        self.configure()

    def configure(self) -> None:
        """Reset the node to the state before the first activation, and configure it."""
        self._forget()
        self.announced = False  # to the other members
        cell, design = self.cell, self.design
        devices = [each.name for each in cell.designs[1:]] if cell.devices else []
        update = {"restart_file": "x" * design.restarts, "volatile_inputs": devices}
        self.table = table_of(cell.run_id, cell.window).model_copy(update=update)
        self.callbacks: dict[str, list[Callable[[Any, str], None]]] = defaultdict(list)  # by topic
        is_master = design.name == cell.master
        self.role = (Spindle if is_master else Recorder if design.records else Stage)(self)
        topics = () if design.records else (design.name,)
        own = Announcement(
            run_id=cell.run_id,
            name=design.name,
            stage="spindle_encoder" if is_master else "tool",
            members=tuple(each.name for each in cell.designs) if is_master else (),
            publishes=topics,
            types=(messages.ENCODER if is_master else messages.STATE,) * len(topics),
            sparse=(False,) * len(topics),
            subscribes=() if design.records else tuple(self.role.inputs.queues),
            parameters=json.dumps({"stall_reaction": cell.stalls, "restart_file": "x" * design.restarts}),
            host=self.process.host,
            pid=self.process.pid,
            session=self.process.pid if is_master else 0,
        )
        if is_master:
            reactions = Reactions(cell.stalls, 0.5, RESTART_TIME, cell.safe_samples, SIZE)
            self.protocol = TimeMasterProtocol(own, cell.window, reactions, first=cell.first)
            self.protocol.know_end(cell.end)
        else:
            self.protocol = MemberProtocol(own, cell.window, wired=not design.records)

    def activate(self) -> None:
        """Activate the node (extends `MemberHost`)."""
        if not self.listens:
            self.listens = True
            net = self.cell.network
            net.forget(self.identity, killed=False)  # after a cleanup, publishers and subscriptions are new ones
            for topic in ("members", "cell_state", "progress"):
                net.advertise(self.identity, topic, 1)
            net.advertise(self.identity, self.full_name, 3 * self.cell.window + 32)
            self.subscribe("members", self.hear_member)
            self.subscribe("cell_state", self.hear_cell_state, always=True)
            self.role.activate()
            self.announced = True
            self.cell.discover(self)
        super().activate()

    @property
    def alive(self) -> bool:
        return self.cell.members.get(self.identity) is self

    # ---- messages

    def subscribe(self, topic: str, callback: Callable[[Any, str], object], *, always: bool = False) -> None:
        self.callbacks[topic].append(self.guarded(callback, always=always))

    def listen(self, queue: BlockQueue) -> None:
        """Subscribe a queue to its topic, over the network or inside this process."""
        if self.exchange.has(queue.topic):
            self.exchange.listen(queue.topic, self.full_name, self.guarded(self.in_turn(queue.take)))
            return
        self.inlets[queue.topic] = queue
        take = self.in_turn(lambda data, sender: (queue.add if isinstance(data, bytes) else queue.accept)(data, sender))
        self.subscribe(queue.topic, take)
        if self.announced:  # a late subscription
            self.cell.discover(self)

    def take(self, topic: str, message: object, sender: str) -> None:
        """Receive a message of a node."""
        self.process.take(partial(self._receive, topic, message, sender))

    def _receive(self, topic: str, message: object, sender: str) -> None:
        for callback in self.callbacks[topic]:
            callback(message, sender)

    # ---- host

    def now(self) -> float:
        return self.cell.now

    def first_sample(self) -> int:
        return self.cell.first

    def has_ended(self, member: Announcement) -> bool:
        return member.host == self.process.host and f"{member.name} {member.pid}" not in self.cell.members

    def refuse(self, message: ForeignMessage) -> None:
        self.strangers += 1

    def look(self) -> None:
        protocol = self.protocol
        protocol.look(self.cell.now, *self.cell.seen_by(self))
        self.next_tick = min(self.next_tick, protocol.look_due)
        if protocol.wants_match:
            protocol.matched(list(self._unmatched()))
        self.perform_actions()

    def _unmatched(self) -> Iterator[str]:
        cell, net, protocol = self.cell, self.cell.network, self.protocol
        for topic in self.inlets:
            for name in protocol.expected_writers(topic):
                other = cell.process_of(name)
                if other is None or not net.is_matched(other.identity, self.identity, topic):
                    yield topic
        for name in protocol.expected_readers(self.full_name) - self.exchange.readers(self.full_name):
            other = cell.process_of(name)
            if other is None or not net.is_matched(self.identity, other.identity, self.full_name):
                yield self.full_name

    def tick(self, now: float) -> None:
        self.next_tick = now + (0.1 if self.protocol.ready else 0.02)
        if self.listens:
            self.look()
            self.next_tick = min(self.next_tick, self.role.tick(now))

    def send(self, action: actions.Action) -> None:
        net, now = self.cell.network, self.cell.now
        match action:
            case actions.Announce(member):
                if self.listens:
                    net.publish(self.identity, "members", member)
            case actions.Say(state):
                if state.state == Phase.RUNNING and state.message:
                    if net.is_cut():  # then some read the last block before they hear of it
                        self.cell.culprits |= {design.name for design in self.cell.designs}
                    self.cell.end = state.end_index  # the run is cut
                net.publish(self.identity, "cell_state", state)
            case actions.Tell(progress):
                if self.exchange.master:
                    self.exchange.master(progress)
                else:
                    net.publish(self.identity, "progress", progress)
            case actions.Report(event, values):
                self.cell.reports.append((now, self.full_name, event, values))
            case actions.Leave(patience):
                # Wait until the others have received its messages, or leave at once if these are not needed.
                acknowledged = net.acknowledged(self.identity) if patience else now
                self.process.block_until(min(acknowledged, now + patience))
                self.protocol.left()


class Stage(StageRun):
    """Stage whose value in a block depends on all that it has read: `lathe_rc.nodes.stage_role.StageRole`."""

    def __init__(self, node: Member) -> None:
        self.node: Member = node
        self.sim, design = node.cell, node.design
        self.together = node.cell.random.choice((1, max(node.table.window // 2, 1)))
        ports = [(name, Input(name, messages.COMMAND, ("position",), delay * SIZE)) for name, delay in design.inputs]
        self.inputs = Inputs(ports, node.table, self.together)
        self._encoder = encoder_of(node.cell.run_id, design.name, STEP_NS)
        self.values: list[int] = []
        self.heard: dict[str, list[int]] = {name: [] for name, _ in design.inputs}  # values of the blocks read
        self.safe_from: int | None = None  # index of the first block in the safe state
        self.restart = Restart(self, self, self) if design.restarts else None
        self.samples = node.cell.first
        self.name = design.name

    def activate(self) -> None:
        self.listen_to_inputs()

    def listen(self, queue: BlockQueue) -> None:
        self.node.listen(queue)

    def perform(self, action: actions.Action) -> None:
        """No action is a member's."""

    def tick(self, now: float) -> float:
        self.hold_quiet_inputs(now)
        return np.inf

    # ---- restart: the stage is its own store

    def feedback_delays(self) -> list[int]:
        inputs = [each for design in self.sim.designs for each in design.inputs]
        return [delay for name, delay in inputs if name == self.name]

    def state(self) -> dict[str, Any]:
        return {"values": list(self.values)}

    def restore(self, state: dict[str, Any]) -> None:
        self.values = list(state["values"])

    def write(self, state: Any) -> None:
        self.sim.files[self.name] = state

    def read(self, restore: Callable[[Any], object]) -> None:
        if self.name not in self.sim.files:
            raise LatheError(f"{self.name}: no state to go on from")
        restore(self.sim.files[self.name])

    # ---- blocks

    def lose(self, lost: frozenset[str], first: int, end: int, *, again: bool) -> None:
        if not again and self.samples > first and self.node.full_name not in self.sim.culprits:
            self.sim.overrun = f"{self.node.identity} hears of the safe state after its first sample"
        super().lose(lost, first, end, again=again)

    def become_safe(self, first: int) -> None:
        self.safe_from = self.sim.block(first)
        process = self.node.process
        process.free_at, self.node.dawdles = max(process.free_at, self.sim.now) + self.node.dawdles, 0.0

    def compute(self, samples: int, *, last: bool) -> None:
        """Compute and publish the next blocks, whose inputs have arrived."""
        node, first, count = self.node, self.samples, -(-samples // SIZE)
        inputs = [signals["position"][::SIZE].astype(int).tolist() for signals in self.inputs.read(first, samples)]
        for values, (name, _) in zip(inputs, node.design.inputs, strict=True):
            self.heard[name] += values
        begin = len(self.values)
        for index, *read in zip(range(self.blocks, self.blocks + count), *inputs, strict=True):
            safe = self.safe_from is not None and index >= self.safe_from
            self.values.append(safe_value(self.name) if safe else mixed(self.name, index, *read))
        node.process.free_at = max(node.process.free_at, self.sim.now) + node.process.cost
        if not node.design.records:
            signals = {"position": np.repeat(np.array(self.values[begin:], float), SIZE)[:samples]}
            run = JoinedBlocks(self._encoder.block(first, signals, None, last=last, companions=0), [0] * count)
            for block in run.blocks(SIZE):
                spoils, node.spoils = node.spoils, 0
                self.sim.network.publish(node.identity, self.name, self._message(block, spoils))
            node.exchange.hand_over(self.name, run)
        self.computed(count, samples, last=last)

    def _message(self, block: Block, spoils: int) -> Block | bytes:
        """Return a block as it is published: spoiled if that is wanted, and in bytes if the cell encodes."""
        encodes = self.sim.encodes and self.name != self.sim.master
        faults = list(SPOILED.values())[: None if encodes else -2]
        block = faults[spoils % len(faults)](block) if spoils else block
        if not encodes:
            return block
        encoder = encoder_of(block.run_id, block.source, block.step_ns)
        signals = {name: array[: block.samples] for name, array in block.signals.items()}
        first, last = abs(block.first_index), block.last  # no message has negative ones
        return encoder.encode(first, signals, last=last, companions=0)[1] if block.samples else bytes(7)

    @property
    def held(self) -> dict[str, int]:
        """Return the index of the block from which the newest one of a lost member is held, or blocks are missing."""
        queues = self.inputs.queues.items()
        found = {name: queue.held_from if queue.lost_from is None else queue.lost_from for name, queue in queues}
        return {name: self.sim.block(sample) for name, sample in found.items() if sample is not None}


class Recorder(Stage):
    """Reader of all topics, which subscribes once all members are known: a bag without a file."""

    subscribed = False

    def activate(self) -> None:
        """Wait for the members."""

    def members_changed(self) -> None:
        if not self.subscribed and self.node.protocol.complete:
            self.subscribed = True
            self.listen_to_inputs()
            self.node.describe(subscribes=tuple(self.inputs.queues))
        super().members_changed()


class Spindle(LeadingRun, Stage):
    """Time master: `lathe_rc.nodes.spindle_role.SpindleRole`."""

    def __init__(self, node: Member) -> None:
        super().__init__(node)
        self.pace = Pace(node.cell.block_time, node.table.window, 8)

    def activate(self) -> None:
        super().activate()
        self.node.subscribe("progress", lambda told, sender: self.leads.hear_progress(told, self.node.now(), sender))

    def check_cell(self) -> None:
        """The designs fit."""

    def perform(self, action: actions.Action) -> None:
        if isinstance(action, actions.TellTime):
            self.sim.look_at_time(self, action.samples)
        super().perform(action)

    def tick(self, now: float) -> float:
        return self.release_due(now)

    def compute(self, samples: int, *, last: bool) -> None:
        before = self.blocks
        super().compute(samples, last=last)
        if not self.node.namesake:
            self.sim.look_at_window(self)
            for blocks in range(before + 1, self.blocks + 1):
                for call in self.sim.at_block.pop(blocks, ()):
                    self.sim.at(self.sim.now + self.sim.delay(), call)


class Simulation:
    """Simulated cell with its network and clock.

    Args:
        seed: seed of all random draws.
        designs: members; the first is the time master.
        window: largest number of blocks in flight; 0: the cell is free-running.
        length: length of the run [block]; the last one has fewer samples, by ``rest``.
        stalls: reaction to silence, ``wait`` or ``safe``.
        groups: members of each process; empty: one each.
        away: places of the processes in ``groups`` that run on a second machine.
        block_time: wall time per block [s]; 0: no pace.
        loses: fraction of the blocks that are lost, in a free-running cell.
        devices: its members read devices that keep no messages, so that the first blocks may be lost.
        encodes: members publish bytes.
        rest: number of samples that the last block lacks.
        safe_samples: length of the safe state.
    """

    def __init__(
        self,
        seed: int,
        designs: tuple[Design, ...],
        window: int,
        length: int,
        stalls: str,
        *,
        groups: Sequence[tuple[Design, ...]] = (),
        away: Sequence[int] = (),
        block_time: float = 0.0,
        loses: float = 0.0,
        devices: bool = False,
        encodes: bool = False,
        rest: int = 0,
        safe_samples: int = 3 * SIZE,
    ) -> None:
        self.first = 1001 * (seed % 2)  # first sample: that of a checkpoint in every other run
        self.random = random.Random(seed)  # noqa: S311 - NumPy's draws are slower one by one
        self.designs, self.window, self.length, self.stalls = designs, window, length, stalls
        self.groups = groups or [(design,) for design in designs]
        self.away, self.block_time, self.loses, self.safe_samples = away, block_time, loses, safe_samples
        self.devices, self.encodes = devices, encodes
        self.end = self.first + length * SIZE - rest
        self.master, self.run_id = designs[0].name, "run"
        self.now = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self.members: dict[str, Member] = {}  # of processes that have not ended
        self.gone: list[Member] = []  # members of processes that have ended in order
        self.dead: list[Member] = []  # members of killed processes
        self.killed: dict[str, float] = {}  # time at which members have left otherwise
        self.since: dict[str, float] = {}  # time at which a member was stopped or killed
        self.files: dict[str, Any] = {}  # newest state of each member that can be restarted
        self.reports: list[tuple[float, str, str, Mapping[str, Any]]] = []
        self.network = Network(self)
        self._pids = 100
        self.slow_match = 0.05  # [s] longest time of discovery
        self.at_block: dict[int, list[Callable[[], None]]] = {}  # disturbances, by number of released blocks
        self.culprits: set[str] = set()  # members with a disturbance that may end the run
        self.plan: list[str] = []
        self.overrun, self.spoiled = "", False

    def block(self, sample: int) -> int:
        """Return the number of blocks that begin before a sample."""
        return -(-(sample - self.first) // SIZE)

    def delay(self) -> float:
        """Return a random transmission time of a message [s]: mostly short, sometimes long."""
        draw = self.random.random()
        return 1e-4 * draw if draw < 0.9 else 0.02 * (draw - 0.9) / 0.1

    def share_lost(self, block: Block, topic: str, reader: str) -> float:
        """Return the share of such blocks that do not arrive: the first and last ones only from devices."""
        from_device = self.devices and topic != self.master
        member = self.members.get(reader)
        if block.last and not (from_device and member and self.master in member.role.inputs.queues):
            return 0.0  # the reader would not know the end of the run
        at_edge = block.last or block.first_index == self.first
        return (10.0 * self.loses if from_device else 0.0) if at_edge else self.loses

    def at(self, time: float, call: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._events, (time, self._number, call))

    def start(self, *designs: Design) -> Member:
        """Start a process whose nodes configure and activate themselves; return the first."""
        self._pids += 1
        host = "there" if any(designs[0] in self.groups[place] for place in self.away) else "here"
        process = Process(self, designs, self._pids, host)
        for member in process.members:
            self.members[member.identity] = member
            member.next_tick = self.now + 0.02 * self.random.random()
        process.start()
        return process.members[0]

    def discover(self, new: Member) -> None:
        """Schedule the discovery between a member and the others, at a random time for each topic."""
        for other in self.members.values():
            if other is new or not other.listens:
                continue
            for writer, reader in ((new, other), (other, new)):
                for topic in ("members", "cell_state", "progress", writer.full_name):
                    if topic in reader.callbacks and not self.network.is_matched(
                        writer.identity, reader.identity, topic
                    ):
                        meet = self.now + self.slow_match * self.random.random()
                        self.at(meet, partial(self.network.match, writer.identity, reader.identity, topic))

    def process_of(self, name: str) -> Member | None:
        return next((each for each in self.members.values() if each.full_name == name), None)

    def seen_by(self, member: Member) -> tuple[dict[str, float], set[str]]:
        """Return silent members of other processes, with their times, and members whose process has ended."""
        silent: dict[str, float] = {}
        ended: set[str] = set()
        for name, known in member.protocol.members.items():
            identity, here = f"{name} {known.pid}", known.host == member.process.host
            other = self.members.get(identity)
            if not known.pid or (here and known.pid == member.process.pid):
                continue
            if other is None and here:
                ended.add(name)
            elif not (here or self.master in (name, member.full_name)):
                continue  # DDS tells liveliness between time master and members
            elif other is None:
                if identity in self.since and self.now - self.since[identity] > LEASE:
                    silent[name] = self.since[identity] + LEASE
            elif other.process.stopped:
                silent[name] = self.since[identity]
            elif self.network.heard_until(member.identity, identity) > self.now + LEASE:
                silent[name] = self.now
        return silent, ended

    def look_at_window(self, master: Spindle) -> None:
        """Record an error if the time master has released more blocks than the window allows."""
        slowest = min(self._blocks(master), default=master.blocks)
        if self.window and master.blocks - slowest > self.window:
            self.overrun = f"{master.blocks - slowest} blocks are in flight"

    def look_at_time(self, master: Spindle, samples: int) -> None:
        """Record an error if the published time is ahead of a member."""
        slowest = min(self._blocks(master), default=master.blocks)
        if self.block(samples) > slowest:
            self.overrun = f"the time of sample {samples} is published; a member has {slowest} blocks"

    def _blocks(self, master: Spindle) -> Iterator[int]:
        for member in self.members.values():
            # A restarted process computes blocks again.
            if member.full_name in master.leads.completed and not (member.design.restarts or member.namesake):
                yield member.role.blocks

    def leave(self, process: Process) -> None:
        """End a process in order."""
        self._remove(process, self.gone, killed=False)

    def kill(self, member: Member) -> None:
        """Kill the process of a member."""
        self.killed |= {each.full_name: self.now for each in member.process.members if each.alive}
        self._remove(member.process, self.dead, killed=True)

    def _remove(self, process: Process, where: list[Member], *, killed: bool) -> None:
        for member in process.members if process.alive else ():
            del self.members[member.identity]
            self.since[member.identity] = self.now
            where.append(member)
            self.network.forget(member.identity, killed=killed)

    def stop(self, member: Member, seconds: float) -> None:
        """Stop the process of a member for a time."""
        process = member.process
        if process.alive and not process.stopped:
            process.stopped = True
            self.since |= {each.identity: self.now for each in process.members}
            self.at(self.now + seconds, process.resume)

    def run(self, until: float = HORIZON) -> None:
        """Play events until every process has ended, or until a simulated time [s]."""
        while self._events and (self.members or self._pids < 100 + len(self.groups)):
            time, _, call = heapq.heappop(self._events)
            if time > until:
                return
            self.now = time
            call()

    def expected(self) -> dict[str, list[int]]:
        """Return the values that each member computes in an undisturbed run."""
        values: dict[str, list[int]] = {design.name: [] for design in self.designs}
        for index in range(self.length):
            for design in self.designs:
                inputs = [values[name][index - delay] if index >= delay else 0 for name, delay in design.inputs]
                values[design.name].append(mixed(design.name, index, *inputs))
        return values
