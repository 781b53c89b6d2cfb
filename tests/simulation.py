# SPDX-License-Identifier: Apache-2.0
"""Simulated cells: members with the real protocol, a network and a clock in one thread, all driven by one seed.

A schedule draws a cell of 3 to 13 members and its disturbances: delays, kills, stops, cuts, slow members, lifecycle
calls, foreign nodes. `Simulation.run` plays it and `violations` checks the guarantees of docs/cell.md. The same seed
gives the same schedule.
"""

import heapq
import json
import random
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import Input
from lathe_rc.blocks.wire import Encoder
from lathe_rc.errors import LatheError
from lathe_rc.protocol import (
    Announcement,
    BadBlock,
    CellState,
    ForeignMessage,
    MemberProtocol,
    Progress,
    Reactions,
    TimeMasterProtocol,
    actions,
)
from lathe_rc.protocol.inputs import Inputs
from lathe_rc.protocol.kept_states import KeptStates
from lathe_rc.stages.tool.tool import ToolParameters

SIZE = 4  # samples in a block
HOST = "here"
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
}


def _shifted(block: Block, samples: int) -> Block:
    return replace(block, first_index=block.first_index + samples, log_ns=block.log_ns + samples * STEP_NS)


@cache
def table_of(run_id: str, window: int) -> ToolParameters:
    """Return the parameters of a simulated member."""
    return ToolParameters(run_id=run_id, window=window, block_size=SIZE)


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
    """Reliable channels between processes: in order on each topic, in any order across topics."""

    def __init__(self, cell: "Simulation") -> None:
        self._cell = cell
        self._history: dict[tuple[str, str], deque[object]] = {}  # newest messages by process and topic
        self._matched: set[tuple[str, str, str]] = set()  # writing process, reading process, topic
        self._newest: dict[tuple[str, str, str], float] = {}  # arrival of the last message
        self._cut: dict[frozenset[str], float] = {}  # end of the interruption by pair of processes

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
        if writer not in self._cell.processes:
            return  # it has ended
        self._history[writer, topic].append(message)
        for reader in self._cell.processes:
            if (writer, reader, topic) in self._matched:
                self._send(writer, reader, topic, message)

    def _send(self, writer: str, reader: str, topic: str, message: object) -> None:
        cell, channel = self._cell, (writer, reader, topic)
        begin = max(cell.now, self._cut.get(frozenset((writer, reader)), 0.0))
        arrival = max(begin + cell.delay(), self._newest.get(channel, 0.0))
        self._newest[channel] = arrival
        cell.at(arrival, partial(self._arrive, channel, message))

    def _arrive(self, channel: tuple[str, str, str], message: object) -> None:
        writer, reader, topic = channel
        if channel in self._matched and reader in self._cell.processes:
            self._cell.processes[reader].take(topic, message, writer.partition(" ")[0])

    def cut(self, one: str, other: str, until: float) -> None:
        self._cut[frozenset((one, other))] = until

    def heard_until(self, one: str, other: str) -> float:
        return self._cut.get(frozenset((one, other)), 0.0)

    def acknowledged(self, writer: str) -> float:
        """Return the arrival time of the last message of a process [s]."""
        return max((time for channel, time in self._newest.items() if channel[0] == writer), default=0.0)

    def forget(self, process: str) -> None:
        """Remove an ended process: its messages in transit may be lost, since they are not repeated."""
        self._history = {key: queue for key, queue in self._history.items() if key[0] != process}
        gone = sorted(key for key in self._matched if process in key[:2])  # the order of a set differs by process
        self._matched.difference_update(key for key in gone if key[1] == process or self._cell.random.random() < 0.5)


class Process:
    """Process with one member: `lathe_rc.nodes.cell_node.CellNode` and its roles, without ROS."""

    def __init__(self, cell: "Simulation", design: Design, pid: int) -> None:
        self.cell, self.design, self.pid = cell, design, pid
        self.identity = f"{design.name} {pid}"
        self.stopped = False
        self.free_at, self.cost = 0.0, 0.0  # end of the computation, and its time per message [s]
        self.dawdles = 0.0  # time that the begin of the safe state takes [s]
        self.spoils = ""  # what is wrong with the next block
        self._inbox: deque[Callable[[], None]] = deque()
        self._waits = False
        self.strangers = 0
        self.namesake = False  # a second node with this name
        self.reports: list[tuple[str, Any]] = []
        self.configure()

    # ---- lifecycle

    def configure(self) -> None:
        """Reset the process to the state before the first activation."""
        cell, design = self.cell, self.design
        self._performs = self.listens = self._has_work = False
        self.blocks = 0
        self.values: list[int] = []
        table = table_of(cell.run_id, cell.window)
        ports = [(name, Input(name, messages.COMMAND, ("position",), delay * SIZE)) for name, delay in design.inputs]
        self.inputs, self.encoder = (
            Inputs(ports, table, 1),
            Encoder(messages.COMMAND, cell.run_id, design.name, STEP_NS),
        )
        for queue in self.inputs.queues.values():
            queue.run_end = lambda: self.protocol.end
        self.heard: dict[str, list[int]] = {name: [] for name, _ in design.inputs}  # values of the blocks read
        self.kept: KeptStates[Any] = KeptStates(cell.window)
        self.safe_from: int | None = None  # index of the first block in the safe state
        self._early: list[tuple[str, Block, str]] = []
        is_master = design.name == cell.master
        own = Announcement(
            run_id=cell.run_id,
            name=design.name,
            stage="spindle_encoder" if is_master else "tool",
            members=tuple(each.name for each in cell.designs) if is_master else (),
            publishes=() if design.records else (design.name,),
            types=() if design.records else (messages.ENCODER if is_master else messages.STATE,),
            sparse=() if design.records else (False,),
            subscribes=() if design.records else tuple(self.heard),
            parameters=json.dumps({"stall_reaction": cell.stalls, "restart_file": "x" * design.restarts}),
            host=HOST,
            pid=self.pid,
            session=self.pid if is_master else 0,
        )
        masters = ("spindle_encoder",)
        self.protocol: MemberProtocol
        if is_master:
            reactions = Reactions(cell.stalls, 0.5, RESTART_TIME, cell.safe_blocks * SIZE, SIZE)
            self.protocol = TimeMasterProtocol(own, cell.window, reactions, masters=masters, first=cell.first)
            self.protocol.know_end(cell.sample(cell.length))
        else:
            self.protocol = MemberProtocol(own, cell.window, masters=masters, wired=not design.records)

    def activate(self) -> None:
        if not self.listens:
            self.listens = True
            self._advertise()
        self.protocol.activate(self.cell.now)
        while self._put_off:
            self._receive(*self._put_off.popleft())
        self._step()

    def _advertise(self) -> None:
        net = self.cell.network
        for topic in ("members", "cell_state", "progress"):
            net.advertise(self.identity, topic, 1)
        net.advertise(self.identity, self.design.name, 3 * self.cell.window + 32)
        self._put_off: deque[tuple[str, object, str]] = deque()
        self.cell.discover(self)

    def reads(self, topic: str) -> bool:
        if topic == "progress":
            return self.design.name == self.cell.master
        if topic in ("members", "cell_state"):
            return True
        follows = self.inputs.pace is not None and topic == self.cell.master
        return self.wired and (topic in self.heard or follows)

    wired = True

    # ---- messages

    def take(self, topic: str, message: object, sender: str) -> None:
        """Receive a message of a node."""
        if self._waits or self.stopped or self._inbox or self.free_at > self.cell.now:
            self._inbox.append(partial(self._receive, topic, message, sender))
            self.wake()
            return
        self.free_at = self.cell.now + self.cost
        self._receive(topic, message, sender)
        self._step()

    def wake(self) -> None:
        """Process the waiting messages one after the other, when the process is free."""
        if self._waits or self.stopped or not self._inbox:
            return
        self._waits = True
        self.cell.at(max(self.cell.now, self.free_at), self._handle)

    def _handle(self) -> None:
        self._waits = False
        if self.stopped or not self.alive or not self._inbox:
            return
        self.free_at = self.cell.now + self.cost
        self._inbox.popleft()()
        self._step()
        self.wake()

    @property
    def alive(self) -> bool:
        return self.cell.processes.get(self.identity) is self

    def _receive(self, topic: str, message: object, sender: str) -> None:
        protocol, now = self.protocol, self.cell.now
        if not self.listens or (protocol.failure and topic != "cell_state"):
            return
        try:
            if isinstance(message, Announcement):
                known = protocol.members.get(message.name)
                if known and known.process != message.process:
                    self.look()
                identity = f"{message.name} {message.pid}"
                if message.name == self.design.name and message.pid and identity not in self.cell.processes:
                    return  # of this member's previous process
                protocol.hear_member(message, now, sender)
            elif isinstance(message, CellState):
                protocol.hear_cell_state(message, now, sender)
            elif isinstance(message, Progress):
                assert isinstance(protocol, TimeMasterProtocol)
                protocol.hear_progress(message, now, sender)
            elif not protocol.active:
                self._put_off.append((topic, message, sender))
            elif isinstance(message, Block):
                self._take_block(topic, message, sender)
        except ForeignMessage:
            self.strangers += 1
        except BadBlock as error:
            protocol.reject(error, now)
        except LatheError as error:
            protocol.fail(error)

    def _take_block(self, topic: str, block: Block, sender: str) -> None:
        if not self.protocol.ready:
            self._early.append((topic, block, sender))
            return
        self._has_work = True
        queue = self.inputs.queues.get(topic) or self.inputs.pace
        assert queue is not None, "it reads the topic"
        queue.accept(block, sender)

    # ---- protocol

    def look(self) -> None:
        """Pass the time, the state of the other members and the graph to the protocol."""
        silent, ended = self.cell.seen_by(self)
        self.protocol.look(self.cell.now, silent, ended)
        self._step()

    def tick(self) -> None:
        if self.alive and not self.stopped and self.listens and not self.protocol.done:
            self.look()
        if self.alive:
            rests = self.protocol.ready and self.design.name != self.cell.master
            self.cell.at(self.cell.now + (0.1 if rests else 0.02), self.tick)

    def _step(self) -> None:
        self._perform_all()
        if self.protocol.wants_match:
            self.protocol.matched(list(self._unmatched()))
            self._perform_all()
        if self._has_work:
            self._has_work = False
            self._work()
            self._perform_all()
        if self.protocol.failure and not self.protocol.others_go_on and not self.protocol.done:
            self.protocol.left()
        if self.protocol.done:
            self.cell.leave(self)

    def _unmatched(self) -> Iterator[str]:
        cell, net, protocol = self.cell, self.cell.network, self.protocol
        for topic in self.heard:
            for name in protocol.expected_writers(topic):
                process = cell.process_of(name)
                if process is None or not net.is_matched(process.identity, self.identity, topic):
                    yield topic
        for name in protocol.expected_readers(self.design.name):
            process = cell.process_of(name)
            if process is None or not net.is_matched(self.identity, process.identity, self.design.name):
                yield self.design.name

    def _perform_all(self) -> None:
        if self._performs or not self.protocol.actions:
            return
        self._performs = self._has_work = True
        while self.protocol.actions:
            try:
                self._perform(self.protocol.actions.popleft())
            except LatheError as error:
                self.protocol.fail(error)
        self._performs = False

    def _perform(self, action: actions.Action) -> None:
        net, now = self.cell.network, self.cell.now
        match action:
            case actions.Announce(member):
                if self.listens:
                    net.publish(self.identity, "members", member)
            case actions.Say(state):
                net.publish(self.identity, "cell_state", state)
            case actions.Tell(progress):
                net.publish(self.identity, "progress", progress)
            case actions.Report(event, values):
                self.reports.append((event, values))
                self.cell.reports.append((now, self.design.name, event, values))
            case actions.MembersChanged():
                self._members_changed()
            case actions.Begin(joins):
                self._begin(joins=joins)
                self.protocol.begun(now)
                early, self._early = self._early, []
                for topic, block, sender in early:
                    self._receive(topic, block, sender)
            case actions.CheckCell():
                assert isinstance(self.protocol, TimeMasterProtocol)
                self.protocol.start(now)
            case actions.Lose():
                self._lose(action)
            case actions.Leave(patience):
                # Wait until the others have received its messages, or leave at once if these are not needed.
                acknowledged = net.acknowledged(self.identity) if patience else now
                self.cell.at(min(acknowledged, now + patience), self._left)

    def _left(self) -> None:
        self.protocol.left()
        self.cell.leave(self)

    def _members_changed(self) -> None:
        if self.design.records and not self.wired and self.protocol.complete:
            self.wired = True
            self.protocol.describe(subscribes=tuple(self.heard))
            self.cell.discover(self)
        peers = self.protocol.master.members if self.protocol.master else ()
        for name, queue in self.inputs.queues.items():
            if name in peers and name in self.protocol.members and queue.source != name:
                queue.expect(name, self.cell.first)
                queue.repeats = self.protocol.restarts(name)

    def _begin(self, *, joins: bool) -> None:
        if joins and not self.design.restarts:
            raise LatheError(f"{self.design.name}: the cell is running already")
        self.inputs.begin(self.cell.first)
        self.kept.begin(delay for each in self.cell.designs for name, delay in each.inputs if name == self.design.name)
        if joins:
            self._resume()
        self._keep()

    def _keep(self) -> None:
        """Store the state, if another process of the member may resume from it."""
        if not self.design.restarts or self.blocks < self.kept.keep_at:
            return
        past = {name: (buffer.end, buffer.past()) for name, buffer in self.inputs.buffers.items()}
        queues = {name: queue.state() for name, queue in self.inputs.queues.items()}
        state = self.blocks, list(self.values), past, queues
        self.cell.files[self.design.name] = self.kept.keep(self.blocks, state)

    def _resume(self) -> None:
        if self.design.name not in self.cell.files:
            raise LatheError(f"{self.design.name}: no state to go on from")
        self.blocks, values, past, queues = self.cell.files[self.design.name]
        self.values = list(values)
        self.protocol.resumed(self.blocks)
        for name, queue in self.inputs.queues.items():
            self.inputs.buffers[name].restart(*past[name])
            queue.go_on(name, queues[name])

    # ---- role

    def _lose(self, action: actions.Lose) -> None:
        if not action.again and self.cell.sample(self.blocks) > action.first:
            self.cell.overrun = f"{self.identity} hears of the safe state after its first sample"
        if not action.again and self.design.name != self.cell.master:
            self.safe_from = self.cell.block(action.first)
            self.free_at, self.dawdles = max(self.free_at, self.cell.now) + self.dawdles, 0.0
        if self.inputs.lose(action.lost, action.end):
            self.inputs.follow(self.cell.master, self.cell.master, action.first)
            self.cell.discover(self)

    @property
    def held(self) -> dict[str, int]:
        """Return the index of the block from which the newest one of a lost member is held."""
        queues = self.inputs.queues.items()
        return {name: self.cell.block(queue.held_from) for name, queue in queues if queue.held_from is not None}

    def _work(self) -> None:
        protocol, cell = self.protocol, self.cell
        if not protocol.active or protocol.over or protocol.failure or not protocol.ready:
            return
        if isinstance(protocol, TimeMasterProtocol):
            while protocol.may_release and protocol.credit > 0 and self.blocks != protocol.blocks_in_run:
                first = cell.sample(self.blocks)
                protocol.starved = not self.inputs.ready(first, self.blocks, 1, in_cell=True)
                if protocol.starved:
                    return
                self._compute(last=self.blocks + 1 == protocol.blocks_in_run)
                self._perform_all()
            return
        while not protocol.over and not protocol.failure:
            ready = self.inputs.ready(self.cell.sample(self.blocks), self.blocks, 1, in_cell=True)
            if ready is None:
                return
            self._compute(last=ready[1])
            self._perform_all()
            self._keep()

    def _compute(self, *, last: bool) -> None:
        """Compute the next block, whose inputs have arrived."""
        first = self.cell.sample(self.blocks)
        inputs = []
        for (name, _), signals in zip(self.design.inputs, self.inputs.read(first, SIZE), strict=True):
            inputs.append(int(signals["position"][0]))
            self.heard[name].append(inputs[-1])
        safe = self.safe_from is not None and self.blocks >= self.safe_from
        value = safe_value(self.design.name) if safe else mixed(self.design.name, self.blocks, *inputs)
        self.values.append(value)
        if isinstance(self.protocol, TimeMasterProtocol):
            self.protocol.release(1, self.cell.now)
        self.blocks += 1
        self.free_at = max(self.free_at, self.cell.now) + self.cost
        if not self.design.records:
            signals = {"position": np.full(SIZE, float(value))}
            block = self.encoder.block(first, signals, None, last=last, companions=0)
            spoiled, self.spoils = SPOILED.get(self.spoils), ""
            self.cell.network.publish(self.identity, self.design.name, spoiled(block) if spoiled else block)
        self.protocol.computed(self.blocks, self.cell.sample(self.blocks), self.cell.now, last=last)
        if self.design.name == self.cell.master and not self.namesake:
            self.cell.look_at_window(self)
            for call in self.cell.at_block.pop(self.blocks, ()):
                self.cell.at(self.cell.now + self.cell.delay(), call)
        if last:
            self.protocol.complete_part()


class Simulation:
    """Simulated cell with its network and clock.

    Args:
        seed: seed of all random draws.
        designs: members; the first is the time master.
        window: largest number of blocks in flight.
        length: length of the run [block].
        stalls: reaction to silence, ``wait`` or ``safe``.
    """

    def __init__(self, seed: int, designs: tuple[Design, ...], window: int, length: int, stalls: str) -> None:
        self.first = 1001 * (seed % 2)  # first sample: that of a checkpoint in every other run
        self.random = random.Random(seed)  # noqa: S311 - NumPy's draws are slower one by one
        self.designs, self.window, self.length, self.stalls = designs, window, length, stalls
        self.master, self.run_id, self.safe_blocks = designs[0].name, "run", 3
        self.now = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self.processes: dict[str, Process] = {}
        self.gone: list[Process] = []  # processes that have ended in order
        self.dead: list[Process] = []  # killed processes
        self.killed: dict[str, float] = {}  # time at which members have left otherwise
        self.since: dict[str, float] = {}  # time at which a process was stopped
        self.files: dict[str, Any] = {}  # newest state of each member that can be restarted
        self.reports: list[tuple[float, str, str, Any]] = []
        self.network = Network(self)
        self._pids = 100
        self.slow_match = 0.05  # [s] longest time of discovery
        self.at_block: dict[int, list[Callable[[], None]]] = {}  # disturbances, by number of released blocks
        self.culprits: set[str] = set()  # members with a disturbance that may end the run
        self.plan: list[str] = []
        self.overrun, self.spoiled = "", False

    def sample(self, blocks: int) -> int:
        """Return the sample at which a block begins."""
        return self.first + blocks * SIZE

    def block(self, sample: int) -> int:
        """Return the number of blocks before a sample."""
        return (sample - self.first) // SIZE

    def delay(self) -> float:
        """Return a random transmission time of a message [s]: mostly short, sometimes long."""
        draw = self.random.random()
        return 1e-4 * draw if draw < 0.9 else 0.02 * (draw - 0.9) / 0.1

    def at(self, time: float, call: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._events, (time, self._number, call))

    def start(self, design: Design) -> Process:
        """Start a process, which configures and activates itself."""
        self._pids += 1
        process = Process(self, design, self._pids)
        process.wired = not design.records
        process._put_off = deque()
        self.processes[process.identity] = process
        process.activate()
        self.at(self.now + 0.02 * self.random.random(), process.tick)
        return process

    def discover(self, new: Process) -> None:
        """Schedule the discovery between a process and the others, at a random time for each topic."""
        for other in self.processes.values():
            if other is new or not other.listens:
                continue
            for writer, reader in ((new, other), (other, new)):
                for topic in ("members", "cell_state", "progress", writer.design.name):
                    if reader.reads(topic):
                        meet = self.now + self.slow_match * self.random.random()
                        self.at(meet, partial(self.network.match, writer.identity, reader.identity, topic))

    def process_of(self, name: str) -> Process | None:
        return next((each for each in self.processes.values() if each.design.name == name), None)

    def seen_by(self, process: Process) -> tuple[dict[str, float], set[str]]:
        """Return silent members, as seen by a process, with their times, and members whose process has ended."""
        silent: dict[str, float] = {}
        ended: set[str] = set()
        for name, member in process.protocol.members.items():
            if name == process.design.name:
                continue
            identity = f"{name} {member.pid}"
            other = self.processes.get(identity)
            if other is None:
                if member.pid:
                    ended.add(name)
            elif other.stopped:
                silent[name] = self.since[identity]
            elif self.network.heard_until(process.identity, identity) > self.now + LEASE:
                silent[name] = self.now
        return silent, ended

    def look_at_window(self, master: Process) -> None:
        """Record an error if the time master has released more blocks than the window allows."""
        assert isinstance(master.protocol, TimeMasterProtocol)
        counted = [
            process.blocks
            for process in self.processes.values()
            if process.design.name in master.protocol.completed
            and not (process.design.restarts or process.namesake)  # a restarted process computes blocks again
        ]
        slowest = min(counted, default=master.blocks)
        if master.blocks - slowest > self.window:
            self.overrun = f"{master.blocks - slowest} blocks are in flight"

    def leave(self, process: Process) -> None:
        """End a process in order."""
        if process.alive:
            del self.processes[process.identity]
            self.gone.append(process)
            self.network.forget(process.identity)

    def kill(self, process: Process) -> None:
        if process.alive:
            del self.processes[process.identity]
            self.killed[process.design.name] = self.now
            self.dead.append(process)
            self.network.forget(process.identity)

    def stop(self, process: Process, seconds: float) -> None:
        if process.alive and not process.stopped:
            process.stopped = True
            self.since[process.identity] = self.now
            self.at(self.now + seconds, partial(self._continue, process))

    def _continue(self, process: Process) -> None:
        process.stopped = False
        if process.alive:
            process.wake()

    def run(self, until: float = HORIZON) -> None:
        """Play events until every process has ended, or until a simulated time [s]."""
        while self._events and (self.processes or self._pids < 100 + len(self.designs)):
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


# ---- schedules


def draw_designs(draw: random.Random) -> tuple[Design, ...]:
    """Draw a cell: a chain of stages with branches and feedback, and a recorder of all topics."""
    count = draw.choice((1, 2, 2, 3, 3, 3, 4, 4, 5, 7, 11))
    names = ["/spindle", *(f"/stage_{number}" for number in range(count))]
    designs = []
    restarting = draw.randrange(1, count + 1) if draw.random() < 0.5 else 0
    for place, name in enumerate(names):
        inputs = {}
        if place:
            inputs = dict.fromkeys(draw.sample(names[:place], min(place, draw.choice((1, 1, 2)))), 0)
        if place < count and draw.random() < (0.15 if place == 0 else 0.3):
            inputs |= {other: draw.choice((1, 1, 2)) for other in draw.sample(names[place + 1 :], 1)}
        designs.append(Design(name, tuple(inputs.items()), restarts=bool(place) and place == restarting))
    return (*designs, Design("/recorder", tuple((name, 0) for name in names)))


class Schedule:
    """Disturbances of a cell, drawn from a seed; described in `Simulation.plan`."""

    def __init__(self, seed: int) -> None:
        draw = random.Random(f"schedule {seed}")  # noqa: S311 - as above
        designs = draw_designs(draw)
        window, length = draw.choice((1, 2, 3, 4, 8)), draw.randrange(4, 25)
        self.cell = cell = Simulation(seed, designs, window, length, draw.choice(("wait", "wait", "safe")))
        cell.slow_match = draw.choice((0.005, 0.05, 0.05, 0.3))
        for design in designs:
            cell.at(draw.choice((0.0, 0.02, 0.3)) * draw.random(), partial(self._launch, design))
        kinds = (*self._HARMLESS, *self._HARMFUL)
        for kind in draw.choices(kinds, k=draw.choice((0, 1, 1, 1, 2, 3))):
            design = draw.choice(designs)
            name, seconds = design.name, draw.choice((0.02, 0.1, 0.3, 2.5, 5.0)) * draw.random()
            when = draw.randrange(1, length + 1) if draw.random() < 0.7 else 0.4 * draw.random()
            cell.plan.append(
                f"{kind} {name} at {f'block {when}' if isinstance(when, int) else f'{when:.3f} s'}, {seconds:.3f} s"
            )
            call = partial(getattr(self, f"_{kind}"), design, seconds, draw.choice(designs))
            if isinstance(when, int):
                cell.at_block.setdefault(when, []).append(call)
            else:
                cell.at(when, call)

    _HARMLESS = ("stop", "cut", "slow", "pause", "stranger", "namesake", "dawdle")
    _HARMFUL = ("kill", "kill", "kill", "interrupt", "shutdown", "clean_up", "claim", "freeze", "spoil")

    def _launch(self, design: Design) -> None:
        self.cell.start(design)

    def _relaunch(self, design: Design) -> None:
        """Start another process of a member, once the one that is shutting down has left."""
        process = self._process(design)
        if process and not process.protocol.active:
            self.cell.at(self.cell.now + 0.1, partial(self._relaunch, design))
        elif process is None:
            self.cell.start(design)

    def _running(self) -> bool:
        """Return True if block 0 has been released."""
        return any(event == "block0" for _, _, event, _ in self.cell.reports)

    def _process(self, design: Design) -> Process | None:
        return self.cell.process_of(design.name)

    # ---- disturbances: each takes a member, a time [s] and another member

    def _stop(self, design: Design, seconds: float, other: Design) -> None:
        if process := self._process(design):
            self.cell.stop(process, seconds)
            if self.cell.stalls == "safe" and seconds > 0.3:
                self.cell.culprits.add(design.name)

    def _freeze(self, design: Design, seconds: float, other: Design) -> None:
        """Stop a process for good, if the cell shall not wait."""
        if (process := self._process(design)) and self.cell.stalls == "safe" and self._running():
            self._blame(design)
            self.cell.stop(process, 1e9)

    def _spoil(self, design: Design, seconds: float, other: Design) -> None:
        """Let a member send a bad block."""
        if (process := self._process(design)) and not design.restarts and not design.records and self._running():
            self._blame(design)
            self.cell.spoiled = True
            process.spoils = list(SPOILED)[int(seconds * 1e6) % len(SPOILED)]

    def _dawdle(self, design: Design, seconds: float, other: Design) -> None:
        """Let the begin of the safe state take its time: the cell has to wait for it."""
        if process := self._process(design):
            process.dawdles = min(seconds, 1.5)

    def _cut(self, design: Design, seconds: float, other: Design) -> None:
        one, another = self._process(design), self._process(other)
        if one and another and one is not another:
            self.cell.network.cut(one.identity, another.identity, self.cell.now + seconds)
            if self.cell.stalls == "safe" and seconds > 0.3:
                self.cell.culprits |= {design.name, other.name}

    def _slow(self, design: Design, seconds: float, other: Design) -> None:
        if process := self._process(design):
            process.cost = min(seconds, 0.02)
            blocks = (len(design.inputs) + 1) * process.protocol.progress_step
            announcements = 2 * len(self.cell.designs)  # in the safe state, on top of the blocks
            if self.cell.stalls == "safe" and process.cost * (blocks + announcements) > 0.2:
                # It reports nothing for longer than ``stall_time``; a slow time master reads no reports for as long.
                slow = [design] if design.name != self.cell.master else self.cell.designs
                self.cell.culprits |= {each.name for each in slow}

    def _pause(self, design: Design, seconds: float, other: Design) -> None:
        """Deactivate a node, and activate it again."""
        if (process := self._process(design)) and process.listens and process.protocol.active:
            process.protocol.deactivate()
            self.cell.at(self.cell.now + min(seconds, 0.3), partial(self._resume, process))
            if self.cell.stalls == "safe":
                self.cell.culprits.add(design.name)

    def _resume(self, process: Process) -> None:
        if process.alive and not process.protocol.done:
            process.activate()

    def _stranger(self, design: Design, seconds: float, other: Design) -> None:
        """Send announcements and a cell state from outside the cell."""
        if process := self._process(design):
            for sender, message in (
                ("/spindle", Announcement("another", "/spindle", "spindle_encoder", 2, ("/spindle",))),
                ("/second", Announcement("run", "/second", "spindle_encoder", 2, ("/second",))),
                ("/ghost", Announcement("run", other.name, "tool", 3, message="no")),
                ("/ghost", Announcement("run", other.name, "tool", 77)),
            ):
                process.take("members", message, sender)
            for state in (
                CellState("another", 3, 0),
                CellState("run", 77, 0),
                CellState("run", 4, 0, "", 9, (other.name,)),
            ):
                process.take("cell_state", state, "/ghost")
            if design.name == self.cell.master:
                process.take("progress", Progress("run", other.name, 10**6, 10**7), "/ghost")

    def _namesake(self, design: Design, seconds: float, other: Design) -> None:
        """Start a second node with a member's name."""
        if self._process(design) and self._running():
            self.cell.start(design).namesake = True

    def _kill(self, design: Design, seconds: float, other: Design) -> None:
        if process := self._process(design):
            self._blame(design)
            self.cell.kill(process)
            self._bring_back(design, seconds)

    def _blame(self, design: Design) -> None:
        if self._running():
            self.cell.culprits.add(design.name)

    def _bring_back(self, design: Design, seconds: float) -> None:
        """Restart a member: the harness, if the member can resume; an operator, any member before the run."""
        if design.restarts or not self._running():
            self.cell.at(self.cell.now + min(seconds, 0.5), partial(self._relaunch, design))

    def _interrupt(self, design: Design, seconds: float, other: Design) -> None:
        """End a process by SIGTERM."""
        if process := self._process(design):
            self._blame(design)
            process.protocol.interrupt("SIGTERM")
            process._perform_all()
            self.cell.leave(process)
            self.cell.killed[design.name] = self.cell.now
            if not self._running():
                self._bring_back(design, seconds)

    def _shutdown(self, design: Design, seconds: float, other: Design) -> None:
        if process := self._process(design):
            self._blame(design)
            process.protocol.shut_down(self.cell.now)
            process._step()
            if not self._running():
                self.cell.killed[design.name] = self.cell.now
                self.cell.at(self.cell.now + 1.2 + min(seconds, 0.5), partial(self._relaunch, design))

    def _clean_up(self, design: Design, seconds: float, other: Design) -> None:
        if (process := self._process(design)) and not process.protocol.takes_part and not self._running():
            self.cell.killed[design.name] = self.cell.now  # the run may begin before the others receive it
            process.protocol.clean_up()
            process._perform_all()
            self.cell.network.forget(process.identity)
            process.configure()
            process.wired = not design.records
            process.activate()

    def _claim(self, design: Design, seconds: float, other: Design) -> None:
        """Report progress of a member for blocks that were never sent."""
        master = self._process(self.cell.designs[0])
        if master and design.name != self.cell.master and self._running():
            self._blame(design)
            master.take("progress", Progress("run", design.name, 10**6, 10**7), design.name)


def violations(cell: Simulation) -> list[str]:
    """Return the guarantees that a cell has violated, after `Simulation.run`."""
    left = [each for each in cell.processes.values() if not _waits_for_another(each)]
    found = [f"{each.identity} hangs" for each in left if not (each.stopped and cell.stalls == "safe")]
    found += [cell.overrun] if cell.overrun else []
    safe = next((cell.block(values["sample"]) for _, _, event, values in cell.reports if event == "safe"), cell.length)
    for _, _, event, values in cell.reports:
        if event == "safe" and cell.block(values["end"]) != (safe if safe == cell.length else safe + cell.safe_blocks):
            found.append(f"a safe state from block {safe} ends with sample {values['end']}")
    everyone = [process for process in (*cell.gone, *cell.processes.values()) if not process.namesake]
    found += _wrong_values(cell, everyone, safe)
    lost = {name for _, _, event, values in cell.reports if event == "safe" for name in values["lost"]}
    to_blame = cell.culprits | cell.killed.keys()
    if not lost <= to_blame:
        found.append(f"lost {sorted(lost)}; {sorted(to_blame)} are to blame")
    found += [f"{name} was not waited for" for name in _lost_too_early(cell)]
    if not cell.culprits and not lost:
        found += [f"{p.identity}: {p.protocol.failure}" for p in everyone if p.protocol.exit_code]
        recorders = [p for p in everyone if p.design.records and p.blocks == cell.length]
        if not recorders and not cell.killed:
            found.append("no recorder has every block")
    # A new process of a killed member may be too late for the end of the run.
    failed = [process for process in everyone if process.protocol.failure and process.design.name not in cell.killed]
    causes = [str(process.protocol.failure) for process in failed]
    if causes and not any(name in text for name in to_blame for text in causes):
        found.append(f"none of {causes} names {sorted(to_blame)}")
    return found


def _wrong_values(cell: Simulation, everyone: list[Process], safe: int) -> list[str]:
    """Return which members have computed other values than offline up to the safe state, or than the safe ones."""
    found, expected = [], cell.expected()
    held = min((index for process in (*everyone, *cell.dead) for index in process.held.values()), default=safe)
    for process in everyone:
        certain = process.values[: min(safe, held)]
        if certain != expected[process.design.name][: len(certain)]:
            found.append(f"{process.identity} has computed other values than offline")
        if process.protocol.safe and process.protocol.over and not process.protocol.failure:
            found += _unsafe(process, cell, safe)
        if len(process.values) > max(cell.length, safe + cell.safe_blocks):
            found.append(f"{process.identity} ran beyond the end")
        if (
            process.protocol.failure
            and not cell.spoiled
            and any(words in str(process.protocol.failure) for words in ("missing", "twice", "heard before"))
        ):
            found.append(f"{process.identity}: {process.protocol.failure}")
    return found


def _unsafe(process: Process, cell: Simulation, safe: int) -> Iterator[str]:
    """Yield what a member lacks at the end of the safe state: its own safe position, or in the bag that of others."""
    blocks = cell.safe_blocks if safe != cell.length else 0
    if process.design.name != cell.master and process.values[safe:] != [safe_value(process.design.name)] * blocks:
        yield f"{process.identity} is not at its safe position"
    left = process.heard.keys() - process.protocol.without - {cell.master} if process.design.records else ()
    yield from (f"the bag lacks {name}" for name in left if process.heard[name][safe:] != [safe_value(name)] * blocks)


def _lost_too_early(cell: Simulation) -> Iterator[str]:
    """Yield the members that were lost alone and dead, although another process of them could still come."""
    died: dict[str, float] = {}
    lost: set[str] = set()
    for time, _, event, values in cell.reports:
        if event == "dead" and values["restarts"]:
            died[values["member"]] = time
        if event == "safe":
            new, lost = set(values["lost"]) - lost, set(values["lost"])
            yield from (
                name
                for name in new
                if len(new) == 1 and f"{name} died" in values["why"] and time - died.get(name, -1.0) < RESTART_TIME
            )


def _waits_for_another(process: Process) -> bool:
    """Return True if a process has lost its time master, or is a second node of one name, or waits for such a master.

    Such a process reports this; an operator ends it, or starts another time master.
    """
    master, cell = process.protocol.master, process.cell
    named = master is not None and process.design.name in master.members
    masters = [each for each in cell.processes.values() if each.design.name == cell.master]
    return process.namesake or (all(each.namesake for each in masters) if masters else not named)


def play(seed: int) -> tuple[Simulation, list[str]]:
    """Play the schedule of a seed; return the cell and its violations."""
    cell = Schedule(seed).cell
    cell.run()
    return cell, violations(cell)
