# SPDX-License-Identifier: Apache-2.0
"""The recorder is compared with ``mcap`` and ``rosbags`` on the same blocks of the piston's four topics.

**write**, uncompressed and with zstd, is timed from the first message to the closed bag, on the disk with the temporary
files. Rates are in messages and MB (of message bytes) per second. Chunks have 256 KiB for ``lathe_rc`` and ``mcap``;
rosbags has no such option. Each compresses at its own level of zstd, ``lathe_rc`` at −20.

- ``lathe_rc``, ``mcap`` and ``rosbags`` get the same finished messages in the order of the bag.
- ``lathe_rc_node`` does the work of the recorder node: it reads and checks each message, sorts it into a row with the
  other topics, and writes rows.
- ``lathe_rc_offline`` also makes the messages from the arrays of a run.

**read** covers all messages of the zstd bag as bytes (``lathe_rc`` checks size and checksum of each chunk), or all
samples: ``lathe_rc_arrays`` as pieces of whole signals, ``rosbags_arrays`` as one object per message.

A ratio is the rate of lathe_rc over that of the other, ``node_ratio`` that of the node.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from benchmarks import sides
from lathe_rc import messages, resources
from lathe_rc.bag import reader
from lathe_rc.bag.reading import stream
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.writing.order import Merger
from lathe_rc.bag.writing.record import OfflineRecorder, begin
from lathe_rc.bag.writing.writer import BagWriter, Compression, offered_qos
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Decoder, Encoder
from lathe_rc.cell import scenario
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals

Action = Callable[[], None]

_CHUNK = 2**18  # as the recorder's default [B]


@dataclass(frozen=True)
class _Material:
    """What is written.

    Attributes:
        piston: the scenario.
        messages: topic, log time [ns] and bytes, in the order of a bag.
        types: message type by topic.
        sources: node by topic.
        chunks: what the engine gave, without sparse messages.
        samples: length of the run.
    """

    piston: scenario.Scenario
    messages: list[tuple[str, int, bytes]]
    types: dict[str, str]
    sources: dict[str, str]
    chunks: list[tuple[int, int, dict[str, Signals]]]
    samples: int

    @property
    def bytes(self) -> int:
        """Of all messages."""
        return sum(len(data) for _, _, data in self.messages)


class _Chunks:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.chunks: list[tuple[int, int, dict[str, Signals]]] = []

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        copied = {topic: {name: array.copy() for name, array in signals.items()} for topic, signals in dense.items()}
        self.chunks.append((first, samples, copied))


def _material(revolutions: float) -> _Material:
    """Run the piston and cut it into messages."""
    piston = scenario.load(resources.find(Path("piston.yaml")), [f"spindle_encoder.revolutions={revolutions}"])
    cell = Cell(piston.nodes)
    engine, kept = Engine(cell), _Chunks()
    engine.run([kept])
    shared, size = piston.shared, piston.shared.block_size
    sources = {f"/{topic}": f"/{source.node}" for topic, source in sorted(cell.dense.items())}
    types = {f"/{topic}": source.type for topic, source in sorted(cell.dense.items())}
    encoders = {t: Encoder(types[t], shared.run_id, sources[t], shared.step_ns) for t in types}
    made: list[tuple[str, int, bytes]] = []
    for first, samples, dense in kept.chunks:
        for start in range(0, samples, size):
            stop = min(start + size, samples)
            last = first + stop == engine.samples
            for topic, encoder in encoders.items():
                block = {name: array[start:stop] for name, array in dense[topic[1:]].items()}
                made.append((topic, *encoder.encode(first + start, block, last=last, companions=0)))
    return _Material(piston, made, types, sources, kept.chunks, engine.samples)


# ---- writing ------------------------------------------------------------------------------------------------------


def _bag(path: Path, what: _Material, compression: Compression) -> BagWriter:
    writer = BagWriter(path, compression=compression, chunk_size=_CHUNK, about={})
    for topic, kind in what.types.items():
        writer.add_topic(topic, kind, offered_qos(1, "volatile"))
    return writer


def _node(path: Path, what: _Material, compression: Compression) -> Action:
    writer, shared = _bag(path, what, compression), what.piston.shared
    dense = {topic: (kind, what.sources[topic]) for topic, kind in what.types.items()}
    merger = Merger(writer, dense, {}, run_id=shared.run_id, step_ns=shared.step_ns, samples=shared.block_size)
    decoders = {topic: Decoder(kind) for topic, kind in what.types.items()}

    def write() -> None:
        for topic, _, data in what.messages:
            if merger.add_block(topic, decoders[topic].decode(data), data):
                merger.release()
        writer.close()

    return write


def _finished(path: Path, what: _Material, compression: Compression) -> Action:
    writer = _bag(path, what, compression)

    def write() -> None:
        for message in what.messages:
            writer.write(*message)
        writer.close()

    return write


def _offline(path: Path, what: _Material, compression: Compression) -> Action:
    recorder = what.piston.nodes["recorder"].model_copy(update={"compression": compression, "chunk_size": _CHUNK})
    piston = scenario.Scenario(what.piston.name, {**what.piston.nodes, "recorder": recorder})
    writer = begin(path, piston)
    sink = OfflineRecorder(Cell(piston.nodes), what.samples, writer)

    def write() -> None:
        for first, samples, dense in what.chunks:
            sink.chunk(first, samples, dense, {})
        writer.close()

    return write


def _definition(kind: str) -> str:
    definition, _ = messages.store().generate_msgdef(kind, ros_version=2)
    return definition


def _mcap(path: Path, what: _Material, compression: Compression) -> Action:
    path.mkdir()
    packed = CompressionType.ZSTD if compression == "zstd" else CompressionType.NONE
    writer = McapWriter(str(path / "bag.mcap"), chunk_size=_CHUNK, compression=packed)
    writer.start("ros2")
    channels = {}
    for topic, kind in what.types.items():
        schema = writer.register_schema(kind, "ros2msg", _definition(kind).encode())
        channels[topic] = writer.register_channel(topic, "cdr", schema)

    def write() -> None:
        for topic, log_ns, data in what.messages:
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()

    return write


def _rosbags(path: Path, what: _Material, compression: Compression) -> Action:
    writer = RosbagWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression == "zstd":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    writer.open()
    store = messages.store()
    topics = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in what.types.items()}

    def write() -> None:
        for topic, log_ns, data in what.messages:
            writer.write(topics[topic], log_ns, data)
        writer.close()

    return write


_WRITERS: dict[str, Callable[[Path, _Material, Compression], Action]] = {
    "lathe_rc": _finished,
    "lathe_rc_node": _node,
    "lathe_rc_offline": _offline,
    "mcap": _mcap,
    "rosbags": _rosbags,
}


def _size(bag: Path) -> int:
    return sum(file.stat().st_size for file in bag.iterdir())


def _write(folder: Path, what: _Material, compression: Compression, rounds: int) -> dict[str, Any]:
    numbers, sizes = count(), dict[str, int]()

    def side(name: str) -> Callable[[], float]:
        def once() -> float:
            path = folder / f"{compression}-{next(numbers)}"
            seconds = sides.seconds(_WRITERS[name](path, what, compression))
            sizes[name] = _size(path)
            return len(what.messages) / seconds

        return once

    found = sides.alternate({name: side(name) for name in _WRITERS}, rounds)
    return _told(found, what, {name: {"bag_mb": size * 1e-6} for name, size in sizes.items()})


def _told(
    found: Mapping[str, Sequence[float]], what: _Material, more: Mapping[str, Mapping[str, float]]
) -> dict[str, Any]:
    """Rates [messages/s] as they are reported."""
    mb = what.bytes / len(what.messages) * 1e-6
    told: dict[str, Any] = {
        name: {
            "messages_per_s": sides.spread(rates),
            "mb_per_s": sides.spread([rate * mb for rate in rates]),
            **more.get(name, {}),
        }
        for name, rates in found.items()
    }
    for name, rates in found.items():
        if not name.startswith("lathe_rc"):
            ours = "lathe_rc_arrays" if name.endswith("_arrays") else "lathe_rc"
            told[name]["ratio"] = sides.ratio(found[ours], rates)
            if node := found.get("lathe_rc_node"):
                told[name]["node_ratio"] = sides.ratio(node, rates)
    return told


# ---- reading ------------------------------------------------------------------------------------------------------


def _read_ours(bag: Path) -> None:
    with BagSource(bag) as source:
        for _ in source.messages():
            pass


def _read_mcap(bag: Path) -> None:
    with next(bag.glob("*.mcap")).open("rb") as stream:
        for _ in make_reader(stream).iter_messages():
            pass


def _read_rosbags(bag: Path) -> None:
    with Reader(bag) as opened:
        for _ in opened.messages():
            pass


def _read_objects(bag: Path) -> None:
    with AnyReader([bag]) as opened:
        for connection, _, data in opened.messages():
            opened.deserialize(data, connection.msgtype)


_READERS: dict[str, Callable[[Path], object]] = {
    "lathe_rc": _read_ours,
    "lathe_rc_arrays": lambda bag: stream.feed(bag, []),
    "mcap": _read_mcap,
    "rosbags": _read_rosbags,
    "rosbags_arrays": _read_objects,
}


def _read(bag: Path, what: _Material, rounds: int) -> dict[str, Any]:
    def side(name: str) -> Callable[[], float]:
        return lambda: len(what.messages) / sides.seconds(lambda: _READERS[name](bag))

    return _told(sides.alternate({name: side(name) for name in _READERS}, rounds), what, {})


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Writing and reading against the two others."""
    what = _material(20.0 if quick else 60.0)
    rounds = 3 if quick else 7
    result: dict[str, Any] = {"messages": len(what.messages), "all_messages_mb": what.bytes * 1e-6}
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as name:
        folder = Path(name)
        compressions: tuple[Compression, ...] = ("none", "zstd")
        bag = folder / "read"
        _node(bag, what, "zstd")()  # this also compiles
        reader.read_bag(bag)
        for compression in compressions:
            say(f"  writing, compression {compression}")
            result[f"write_{compression}"] = _write(folder, what, compression, rounds)
        say("  reading")
        result["read_zstd"] = _read(bag, what, rounds)
    return result
