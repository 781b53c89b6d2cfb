# SPDX-License-Identifier: Apache-2.0
"""What the middleware allows: the messages of a cell, passed along its topics by processes that compute nothing.

There are as many processes as the cell has nodes. Their messages are those of the same cell, recorded offline before:
the same types, sizes, contents and number, blocks as well as messages at chosen samples. A process publishes its bytes
for a block once it has taken the blocks that the node would need for it, with the same quality of service and the same
window of blocks in flight, of which the same Progress messages tell. Subscriptions are raw; for messages a process
waits in a bare wait set. The recorder writes what it takes with the plain ``mcap`` writer and zstd.

python -m benchmarks.transport FILE is one of the processes. It prints "ready" when it has met its neighbours, and what
it has found when its part is over; the spindle waits for a line of input first, all of them for its end at last.
"""

import contextlib
import ctypes
import gc
import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from lathe_rc import harness, messages
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

ROOT = Path(__file__).resolve().parents[1]
_PATIENCE = 60.0  # [s] for the neighbours, for the next message, and for a run
_WAIT_NS = 100_000_000  # [ns] until a process looks whether it has lost its patience
_PR_SET_TIMERSLACK = 29  # from <linux/prctl.h>
_PROGRESS = "progress"


@dataclass(frozen=True)
class Part:
    """What a process passes on.

    Attributes:
        name: of the node.
        table: its parameters.
        blocks: of each topic that carries blocks.
        types: message type of each topic that it publishes or takes.
        waits: topics whose blocks it needs before it may publish its own, and how late it reads them [sample].
        takes: topics that it takes.
        sends: topic and bytes of what it publishes, by block.
        readers: how many take each of its topics.
        members: who tells it how far they have come; nobody, unless it is the spindle.
        bag: file that it writes; none, unless it is the recorder.
        count: messages that it takes in all.
    """

    name: str
    table: NodeParameters
    blocks: int
    types: Mapping[str, str]
    waits: Mapping[str, int]
    takes: Sequence[str]
    sends: Sequence[Sequence[tuple[str, bytes]]]
    readers: Mapping[str, int]
    members: Sequence[str]
    bag: str
    count: int


# ---- a process -------------------------------------------------------------------------------------------------------


class Process:
    """One of the processes; see the module.

    Args:
        part: what it passes on.

    Attributes:
        taken: messages so far, by topic.
    """

    def __init__(self, part: Part) -> None:
        import rclpy
        from lathe_rc_msgs.msg import Progress
        from rclpy.signals import SignalHandlerOptions

        from lathe_rc.nodes import dds
        from lathe_rc.nodes.ports import latched_qos, message_class, signal_qos

        dds.settle()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # so that it ends when it is told to
        node = rclpy.create_node(part.name, enable_rosout=False, start_parameter_services=False)
        self.part, table = part, part.table
        self.taken = dict.fromkeys(part.takes, 0)
        self._sent, self._size = 0, table.block_size
        self._outlets = {
            topic: node.create_publisher(message_class(part.types[topic]), topic, signal_qos(table))
            for topic in part.readers
        }
        self._inlets = {
            topic: node.create_subscription(
                message_class(part.types[topic]), topic, _unused, signal_qos(table, topic), raw=True
            )
            for topic in part.takes
        }
        self._tellings: dict[int, bytes] = {}
        self._told: dict[bytes, tuple[str, int]] = {}
        self._completed = dict.fromkeys(part.members, 0)
        if part.members:
            self._told = {data: (name, k) for name in part.members for k, data in self._progress_of(name).items()}
            self._inlets[_PROGRESS] = node.create_subscription(Progress, _PROGRESS, _unused, latched_qos(), raw=True)
        else:
            self._tellings = self._progress_of(part.name)
            self._outlets[_PROGRESS] = node.create_publisher(Progress, _PROGRESS, latched_qos(1))
        self._wait_set = _WaitSet(node, list(self._inlets.values()))

    def _progress_of(self, name: str) -> dict[int, bytes]:
        """What a member says of how far it has come, by the blocks at which it does."""
        kind, run_id, blocks = f"{messages.PACKAGE}/msg/Progress", self.part.table.run_id, self.part.blocks
        step, made = max(1, self.part.table.window // 4), messages.store().types[kind]
        told_at = (*range(step, blocks, step), blocks)
        return {k: messages.encode(kind, made(run_id, f"/{name}", k, k * self._size, 0)) for k in told_at}

    def met(self) -> bool:
        """Whether its neighbours are there."""
        readers, writers = {**self.part.readers, _PROGRESS: 1}, {_PROGRESS: len(self.part.members)}
        heard = all(outlet.get_subscription_count() >= readers[topic] for topic, outlet in self._outlets.items())
        return heard and all(
            inlet.get_publisher_count() >= writers.get(topic, 1) for topic, inlet in self._inlets.items()
        )

    def take(self) -> None:
        """Take what is there, once there is something.

        Raises:
            LatheError: nothing comes.
        """
        limit = time.monotonic() + _PATIENCE
        while not (ready := self._wait_set.wait()):
            if time.monotonic() > limit:
                raise LatheError(f"{self.part.name} waits in vain after block {self._sent}: {self.taken}")
        for topic, inlet in self._inlets.items():
            if inlet.handle.pointer in ready:
                with inlet.handle:
                    while (found := inlet.handle.take_message(inlet.msg_type, True)) is not None:  # noqa: FBT003 - raw
                        self.hear(topic, found[0])

    def hear(self, topic: str, data: bytes) -> None:
        """A message has come."""
        if topic == _PROGRESS:
            name, blocks = self._told[data]
            self._completed[name] = blocks
        else:
            self.taken[topic] += 1

    def _allowed(self) -> int:
        """Blocks that may be published by now."""
        if self.part.members:
            return min(self.part.blocks, min(self._completed.values()) + self.part.table.window)
        taken, size = self.taken, self._size
        return min(self.part.blocks, *((taken[topic] * size + late) // size for topic, late in self.part.waits.items()))

    def _pass_on(self) -> None:
        """Publish what may be."""
        outlets, sends = self._outlets, self.part.sends
        for block in range(self._sent, self._allowed()):
            for topic, data in sends[block]:
                outlets[topic].publish(data)
            self._sent = block + 1
            if self._sent in self._tellings:
                outlets[_PROGRESS].publish(self._tellings[self._sent])

    def run(self) -> dict[str, Any]:
        """Pass all blocks on; when it began."""
        gc.collect()
        gc.freeze()
        begun = time.monotonic_ns()
        self._pass_on()
        while self._sent < self.part.blocks:
            self.take()
            self._pass_on()
        return {"begun_ns": begun}


class Recorder(Process):
    """The process that writes; see `Process`."""

    def __init__(self, part: Part) -> None:
        super().__init__(part)
        assert isinstance(part.table, RecorderParameters)
        self._file = Path(part.bag).open("wb")  # noqa: SIM115 - closed when the run is over
        self._writer = Writer(self._file, chunk_size=part.table.chunk_size, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="benchmarks.transport")
        self._channels = {}
        for topic in part.takes:
            text = messages.store().generate_msgdef(part.types[topic], ros_version=2)[0]
            schema = self._writer.register_schema(part.types[topic], "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)

    def hear(self, topic: str, data: bytes) -> None:
        """See `Process`."""
        now = time.time_ns()
        self._writer.add_message(self._channels[topic], now, data, now)
        self.taken[topic] += 1

    def run(self) -> dict[str, Any]:
        """Write all messages; when the last of them was in the bag."""
        super().run()
        while sum(self.taken.values()) < self.part.count:
            self.take()
        complete = time.monotonic_ns()
        self._writer.finish()
        self._file.close()
        return {"complete_ns": complete, "taken": self.taken}


def _unused(_message: bytes) -> None:
    """A callback, for which there is no executor."""


class _WaitSet:
    """A wait set of subscriptions, as an executor would have one.

    Args:
        node: that they belong to.
        inlets: the subscriptions.
    """

    def __init__(self, node: Any, inlets: Sequence[Any]) -> None:
        from rclpy.impl.implementation_singleton import rclpy_implementation

        self._handles = [inlet.handle for inlet in inlets]
        self._set = rclpy_implementation.WaitSet(len(inlets), 0, 0, 0, 0, 0, node.context.handle)

    def wait(self) -> list[int]:
        """Pointers of the subscriptions that have something; none after a while."""
        self._set.clear_entities()
        for handle in self._handles:
            self._set.add_subscription(handle)
        self._set.wait(_WAIT_NS)
        return list(self._set.get_ready_entities("subscription"))


def main(file: str) -> None:
    """Be one of the processes."""
    part: Part = pickle.loads(Path(file).read_bytes())  # noqa: S301 - of the process that has started this one
    # As nodes do whose cell runs as fast as it can, see `lathe_rc.nodes.process`.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    process = Recorder(part) if part.bag else Process(part)
    limit = time.monotonic() + _PATIENCE
    while not process.met():
        if time.monotonic() > limit:
            sys.exit(f"{part.name} has not met its neighbours")
        time.sleep(0.02)
    print("ready", flush=True)
    if part.members:
        sys.stdin.readline()
    print(json.dumps(process.run()), flush=True)
    sys.stdin.read()
    os._exit(0)  # Fast DDS may wait for itself for ever while others are leaving, too


# ---- all of them -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Passed:
    """What a run took.

    Attributes:
        wall_s: from the first block to the last message in the bag.
        simulated_s: time that the samples stand for.
        taken: messages in the bag by topic.
    """

    wall_s: float
    simulated_s: float
    taken: Mapping[str, int]

    @property
    def real_time_factor(self) -> float:
        """Simulated over wall time."""
        return self.simulated_s / self.wall_s


class Transport:
    """The messages of a scenario without what makes them.

    Args:
        scenario: with a recorder.
        folder: for its files, among them the bag, which each run writes anew.

    Attributes:
        bag: see above.
        sent: messages by topic, in the order in which they are published.
    """

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self._scenario, self._folder, self._cell = scenario, folder, Cell(scenario.nodes)
        self.bag = folder / "passed.mcap"
        run = harness.run(scenario, bag=folder / "recorded")
        self._simulated_s, self._blocks = run.simulated_s, run.blocks
        sources = {**self._cell.dense, **self._cell.sparse}
        self._types = {f"/{topic}": source.type for topic, source in sources.items()}
        self._nodes = {f"/{topic}": source.node for topic, source in sources.items()}
        self._dense = {f"/{topic}" for topic in self._cell.dense}
        self.sent: dict[str, list[bytes]] = {topic: [] for topic in self._types}
        sends: dict[str, list[list[tuple[str, bytes]]]] = {
            name: [[] for _ in range(self._blocks)] for name in self._cell.stages
        }
        size = scenario.shared.step_ns * scenario.shared.block_size
        with next((folder / "recorded").glob("*.mcap")).open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
                self.sent[channel.topic].append(message.data)
                block = (message.log_time - messages.START_NS) // size
                sends[self._nodes[channel.topic]][block].append((channel.topic, message.data))
        for of_blocks in sends.values():
            for block_of in of_blocks:
                block_of.sort(key=lambda sent: sent[0] in self._dense)  # nodes publish the blocks last
        self._files: dict[str, Path] = {}
        for name, table in scenario.nodes.items():
            stage = self._cell.stages.get(name)
            part = self._part(stage, sends[name]) if stage else self._recorder(name, table)
            self._files[name] = folder / f"{name}.part"
            self._files[name].write_bytes(pickle.dumps(part))

    def _part(self, stage: Stage, sends: Sequence[Sequence[tuple[str, bytes]]]) -> Part:
        """What the process of a stage passes on."""
        waits: dict[str, int] = {}
        for port in stage.inputs:
            topic = f"/{remapped(stage.shared, port.topic)}"
            waits[topic] = min(port.delay, waits.get(topic, port.delay))
        own = [topic for topic, node in self._nodes.items() if node == stage.name]
        others = [name for name in self._scenario.nodes if name != stage.name]
        return Part(
            name=stage.name,
            table=stage.shared,
            blocks=self._blocks,
            types=self._types,
            waits=waits,
            takes=list(waits),
            sends=sends,
            readers={topic: 1 + len(self._cell.readers(topic[1:])) for topic in own},  # and the recorder
            members=others if stage is self._cell.master else [],
            bag="",
            count=0,
        )

    def _recorder(self, name: str, table: NodeParameters) -> Part:
        """The same of the recorder, which takes everything."""
        return Part(
            name=name,
            table=table,
            blocks=self._blocks,
            types=self._types,
            waits=dict.fromkeys(self._dense, 0),
            takes=list(self._types),
            sends=[()] * self._blocks,
            readers={},
            members=[],
            bag=str(self.bag),
            count=sum(map(len, self.sent.values())),
        )

    def run(self) -> Passed:
        """Pass all messages.

        Raises:
            LatheError: a process has ended too early.
        """
        with _started(self._files) as children:
            master, recorder = self._cell.master.name, next(n for n in self._files if n not in self._cell.stages)
            for name, child in children.items():
                if _line(child) != "ready\n":
                    raise LatheError(f"bare transport: {name} has not started")
            stdin = children[master].stdin
            assert stdin, "it was opened"
            stdin.write("go\n")
            stdin.flush()
            told: dict[str, dict[str, Any]] = {}
            for name, child in children.items():
                line = _line(child)
                if not line:
                    raise LatheError(f"bare transport: {name} has ended too early")
                told[name] = json.loads(line)
            for child in children.values():
                child.communicate(timeout=_PATIENCE)
        wall = (told[recorder]["complete_ns"] - told[master]["begun_ns"]) * 1e-9
        return Passed(wall, self._simulated_s, told[recorder]["taken"])


def _line(child: "subprocess.Popen[str]") -> str:
    assert child.stdout, "it was opened"
    return child.stdout.readline()


@contextlib.contextmanager
def _started(files: Mapping[str, Path]) -> Iterator[dict[str, "subprocess.Popen[str]"]]:
    """The processes by name, in a domain of their own; none is left behind."""
    limit = ["timeout", "-k", "5", f"{3 * _PATIENCE:g}"]  # they end, whatever becomes of this process
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(harness.free_domain())
        environment = os.environ | {"PYTHONPATH": paths, "ROS_DOMAIN_ID": str(domain)}
        children: dict[str, subprocess.Popen[str]] = {}
        for name, file in files.items():
            command = [*limit, sys.executable, "-m", "benchmarks.transport", str(file)]
            children[name] = stack.enter_context(
                subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
            stack.callback(children[name].terminate)
        yield children


if __name__ == "__main__":
    main(sys.argv[1])
