# SPDX-License-Identifier: Apache-2.0
"""Bags that are made to harm: bombs, wrong lengths, indexes, names, metadata, schemas, files that are none.

Each maker takes a folder and a ``random.Random`` and returns the bag; `attack` calls a command with it, under limits,
and says what must not be. tests/bag/test_hostile_bags.py has a sample, tests/system/test_hostile_campaign.py thousands.
"""

import contextlib
import os
import resource
import shutil
import signal
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from hashlib import sha256
from pathlib import Path
from random import Random
from typing import Any

import fuzz_mutate as mutate
import fuzz_targets as fuzz
import lz4.frame
import yaml
import zstandard
from bags import EMPTY, FIRST, SCHEMA, channel, chunk, chunk_index, lathe, mcap, mcap_writer, record, statistics
from mcap.records import ChunkIndex, Statistics
from mcap.writer import CompressionType, IndexType

MEMORY = 2**30  #: that a command may take beyond what the process has [B]
LONGEST = 30  #: of CPU time [s]
STRING = b"\0\1\0\0\2\0\0\0x\0"
NAMES = (
    *("/", "/tool/", "/../../x", "//", "/a b", "relative", "~/x", "/1a", "/é", "/{node}", "/" + "x" * 1024),
    *("", "/\u202eelif", "/a\nb", "/\x1b[2J", "/clock", "/tool", "/encoder", "/tool/joint_states", "/cell_state"),
    *("/.", "/a/b/c/d/e/f"),
)  # fmt: skip
TYPES = (
    *("std_msgs/msg/String", "std_msgs/String", "x", "", "a/msg/B", "lathe_rc_msgs/msg/ToolBlock", "../msg/x"),
    *("os/msg/system", "lathe_rc_msgs/msg/EncoderBlock", "lathe_rc_msgs/msg/Event", "x" * 1025),
    *("std_msgs/srv/String", "std_msgs/msg/"),
)  # fmt: skip
QOS = (
    *("", "[]", "{}", "- {reliability: 1}", "a: b: c", "&a [*a]", "[" * 50, "- 5\n- durability: true\n", "x" * 9999),
    *("- depth: 1e9\n  history: keep_all", "reliability: reliable", "? [a]", "- !!python/name:os.system x"),
)  # fmt: skip
DEFINITIONS = (b"string data", b"", b"\xff", b"x" * 10**5, b"uint8[] data", bytes(range(256)))
ODD: Sequence[Any] = (
    *(None, [], {}, "", "null", 0, -1, 2**63, 2**64, 10**30, 1.5, float("nan"), True, "2001-99-99", "x" * 5000),
    *([None], [[]], {"a": None}, "../../etc/passwd", "/dev/zero", "/", "..", ".", "bag.mcap", ["bag.mcap"] * 5000),
    *("cdr", "json"),
)  # fmt: skip


# ---- makers


def _bomb(folder: Path, random: Random) -> Path:
    """Chunks that unpack to far more than the file, of what takes long to read, with or without an index."""
    whole = random.choice(
        (
            bytes(9),  # empty records
            EMPTY,
            record(5, EMPTY[9:] + STRING),
            record(3, struct.pack("<HIII", 1, 0, 0, 0)),  # schemas
            record(4, b""),
        )
    )
    size, count = random.choice((2**16, 2**20, 2**24, 2**26)), random.choice((1, 3, 40))
    if whole[0] == 5:  # sound messages: to copy some millions of them takes its time, as that of any bag
        size, count = min(size, 2**24), min(count, 3)
    whole *= size // len(whole)
    declared = random.choice((len(whole), len(whole), 2**28, 2**27, 2**62, 1))
    name, packed = random.choice(
        (
            (b"zstd", zstandard.compress(whole)),
            (b"lz4", lz4.frame.compress(whole)),
            (b"zstd", zstandard.compress(b"") * random.choice((10, 10**5, 10**6))),
            (b"lz4", lz4.frame.compress(b"") * 10**5),
        )
    )
    announced, one, summary = SCHEMA + channel(), chunk(compression=name, size=declared, packed=packed), b""
    if random.random() < 0.5:
        first = FIRST + len(announced)
        places = range(first, first + count * len(one), len(one))
        index = b"".join(chunk_index(place, len(one), size=declared, packed=len(packed)) for place in places)
        summary = announced + index + statistics(count, random.choice((5, 2**63)))
    return mcap(folder / "bag.mcap", announced + count * one, summary)


def _written(folder: Path, random: Random) -> Path:
    """Odd names, types, encodings, definitions, quality of service and times, in files of any layout."""
    path = folder / "bag.mcap"
    types = random.choice((IndexType.ALL, IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE))
    compression = random.choice(list(CompressionType))
    options: dict[str, Any] = {"use_chunking": random.random() < 0.7, "use_statistics": random.random() < 0.8}
    options |= {"index_types": types, "compression": compression, "chunk_size": random.choice((1, 500, 10**6))}
    options |= {"use_summary_offsets": random.random() < 0.5, "repeat_channels": random.random() < 0.8}
    with mcap_writer(path, random.choice(("ros2", "", "ros1", "x" * 1000)), **options) as writer:
        channels: list[int] = []
        for _ in range(random.choice((0, 1, 3, 3, 3, 100, 5000))):
            encoding = random.choice(("ros2msg", "ros2msg", "ros2idl", "jsonschema", ""))
            schema = writer.register_schema(random.choice(TYPES), encoding, random.choice(DEFINITIONS))
            kind = random.choice(("cdr", "cdr", "cdr", "json", "", "ros1"))
            name = random.choice((*NAMES, "/good")) + random.choice(("", str(len(channels))))
            number = random.choice((schema, schema, 0, 77))
            channels.append(writer.register_channel(name, kind, number, {"offered_qos_profiles": random.choice(QOS)}))
        for number in range(random.choice((0, 5, 300)) if channels else 0):
            log_ns = random.choice((10**18 + number, 10**18 + number, 0, 2**63, 2**64 - 1, 10**18 - number * 10**9))
            data = random.choice((STRING, STRING, b"", random.randbytes(50), b"\0\1\0\0" + b"\xff" * 60))
            writer.add_message(random.choice(channels), log_ns, data, log_ns, number)
    return path


def _index(folder: Path, random: Random) -> Path:
    """One number of the index or the statistics that is another."""
    path = folder / "bag.mcap"
    with mcap_writer(path, chunk_size=200, enable_crcs=False) as writer:
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")]
        for number in range(40):
            writer.add_message(channels[number % 2], 10**18 + number, STRING, 10**18 + number)
        indexes: list[ChunkIndex] = writer._Writer__chunk_indices  # type: ignore[attr-defined]
        statistics: Statistics = writer._Writer__statistics  # type: ignore[attr-defined]
        for _ in range(random.choice((1, 3))):
            target: Any = random.choice([*indexes, statistics])
            name = random.choice([name for name, value in vars(target).items() if isinstance(value, int)])
            small = isinstance(target, Statistics) and name.endswith("_count") and name != "message_count"
            most = 2 ** (16 if name == "schema_count" else 32 if small else 64) - 2  # the writer adds one to some
            setattr(target, name, min(random.choice((*mutate.NUMBERS, getattr(target, name) + 1)), most))
    return path


def _metadata(folder: Path, random: Random) -> Path:
    """A value of the metadata that is another one, or none."""
    bag = _folder(folder, random.choice(fuzz._folder_seeds()))
    told = yaml.safe_load((bag / "metadata.yaml").read_text())
    for _ in range(random.choice((1, 1, 4))):
        _spoil(told, random)
    text = yaml.safe_dump(told if random.random() < 0.9 else random.choice(ODD))
    text = random.choice((text, text, text, text + "\n" * 15_000_000, "# " + "x" * 2**24 + text, text + "&a [*a]"))
    (bag / "metadata.yaml").write_text(text)
    return bag


def _spoil(node: Any, random: Random) -> None:
    """Replace, remove or double one part somewhere below."""
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    if not keys:
        return
    key = random.choice(keys)
    if isinstance(node[key], dict | list) and random.random() < 0.8:
        _spoil(node[key], random)
    elif random.random() < 0.2:
        del node[key]
    else:
        node[key] = random.choice(ODD)


def _no_file(folder: Path, random: Random) -> Path:
    """A pipe, a folder, a link or nothing where a file should be; a lone one as well."""
    bag = _folder(folder, random.choice(fuzz._folder_seeds()))
    place = random.choice(sorted(bag.iterdir()))
    whole = folder / "whole"
    shutil.move(place, whole)
    what = random.randrange(8)
    targets = {1: "/dev/zero", 2: "/dev/stdin", 3: str(place), 4: "nowhere", 5: "/etc/passwd", 6: str(whole)}
    if what == 0:
        os.mkfifo(place)
    elif what == 7:
        place.mkdir()
    else:
        place.symlink_to(targets[what])
    return place if random.random() < 0.2 else bag


def _database(folder: Path, random: Random) -> Path:
    """Rows, tables and pages of SQLite that are not as rosbag2 makes them."""
    bag = _folder(folder, random.choice([seed for seed in fuzz._folder_seeds() if b"SQLite format" in seed]))
    path = next(bag.glob("*.db3*"))
    statements = (
        "UPDATE messages SET timestamp = -5", "UPDATE messages SET timestamp = 'x'", "UPDATE messages SET data = NULL",
        "UPDATE messages SET data = 'text'", "UPDATE messages SET topic_id = 99", "UPDATE messages SET topic_id = NULL",
        "DROP TABLE topics", "DROP TABLE messages", "DELETE FROM topics", "UPDATE topics SET name = NULL",
        "UPDATE topics SET type = x'ff'", "UPDATE topics SET id = -5", "UPDATE topics SET offered_qos_profiles = '{'",
        "UPDATE topics SET serialization_format = 'json'", "UPDATE topics SET name = '/../../x'",
        "CREATE VIEW v AS SELECT 1", "CREATE TRIGGER t AFTER INSERT ON topics BEGIN SELECT 1; END",
        "UPDATE messages SET data = zeroblob(268435456) WHERE id = 1", "UPDATE messages SET data = zeroblob(1000000)",
        "UPDATE messages SET timestamp = 9223372036854775807 WHERE id % 2",
        "ALTER TABLE messages RENAME COLUMN id TO number", "UPDATE topics SET id = id + 100000",
        "INSERT INTO messages SELECT NULL, 1, a.id * 600 + b.id, x'' FROM messages a, messages b, messages c",
    )  # fmt: skip
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(path)) as base:
        for _ in range(random.choice((0, 1, 2))):
            base.execute(random.choice(statements))
        base.commit()
    data = bytearray(path.read_bytes())
    for _ in range(random.choice((0, 0, 1, 20))):
        data[random.randrange(100, len(data))] = random.randrange(256)
    path.write_bytes(data[: random.choice((len(data), len(data), len(data) // 2))])
    if random.random() < 0.2:
        path.with_name(path.name + random.choice(("-wal", "-journal"))).write_bytes(random.randbytes(5000))
    return random.choice((bag, path))


def _damaged(folder: Path, random: Random) -> Path:
    """Damage to a run that can be simulated again: records, metadata or bytes."""
    target = fuzz.TARGETS[random.choice(("resim", "resim", "folder"))]
    return _folder(folder, target.damaged(random))


def _damaged_file(folder: Path, random: Random) -> Path:
    (folder / "bag.mcap").write_bytes(fuzz.TARGETS["mcap"].damaged(random))
    return folder / "bag.mcap"


def _folder(folder: Path, data: bytes) -> Path:
    fuzz.write_folder(folder / "bag", data)
    return folder / "bag"


MAKERS: dict[str, Callable[[Path, Random], Path]] = {
    "bomb": _bomb,
    "written": _written,
    "index": _index,
    "metadata": _metadata,
    "no file": _no_file,
    "database": _database,
    "damaged": _damaged,
    "damaged file": _damaged_file,
}  #: kinds of hostile bags


# ---- commands

COMMANDS: dict[str, tuple[str, ...]] = {
    "check": ("bag", "check", "BAG"),
    "info": ("bag", "info", "BAG"),
    "json": ("bag", "info", "BAG", "--json"),
    "recover": ("bag", "recover", "BAG", "-o", "OUT/new"),
    "tachogram": ("bag", "tachogram", "BAG", "-o", "OUT/speed.csv"),
    "measure": ("measure", "BAG"),
    "export": ("export", "BAG", "--csv", "-o", "OUT/tables"),
    "report": ("report", "BAG", "-o", "OUT/page.html"),
    "view": ("view", "BAG", "-o", "OUT/bag.rrd"),
    "resim": ("resim", "BAG", "-o", "OUT/again"),
    "replay": ("replay", "BAG", "--rate", "0"),
}  #: those that take a bag


class HarmError(AssertionError):
    """Harm done by a command."""


def _too_long(*_: object) -> None:
    raise HarmError(f"more than {LONGEST} s of CPU time")


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Bound memory and time of this process."""
    # Data, not address space: the engine that draws a report's pictures reserves much more than it uses.
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5])
    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (pages * resource.getpagesize() + MEMORY, before[1]))
    handler = signal.signal(signal.SIGPROF, _too_long)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _seal(folder: Path) -> dict[str, str]:
    """Hash of each file of a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        found[str(path.relative_to(folder))] = sha256(content).hexdigest()
    return found


def words(command: str, bag: Path, out: Path) -> list[str]:
    """The command line."""
    return [word.replace("BAG", str(bag)).replace("OUT", str(out)) for word in COMMANDS[command]]


def attack(box: Path, bag: Path, command: str) -> tuple[int, str]:
    """Exit code and output of a command, called in ``box``.

    Raises:
        HarmError: a traceback, too much memory or time, anything that is left or changed.
    """
    out, here, temporary = (box / name for name in ("out", "here", "temporary"))
    for folder in (out, here, temporary):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    before = _seal(bag.parent)
    was, before_it = Path.cwd(), tempfile.tempdir
    os.chdir(here)
    tempfile.tempdir = str(temporary)
    try:
        with limits():
            done = lathe(*words(command, bag, out))
    finally:
        os.chdir(was)
        tempfile.tempdir = before_it
    if done.exception and not isinstance(done.exception, SystemExit):
        raise HarmError(f"{command}: {type(done.exception).__name__}: {done.exception}") from done.exception
    if done.exit_code not in (0, 1, 2, 3) or "not enough memory" in done.output:
        raise HarmError(f"{command}: exit code {done.exit_code}: {done.output[-300:]}")
    if done.exit_code == 2 and len([line for line in done.stderr.splitlines() if line.startswith("lathe: ")]) != 1:
        raise HarmError(f"{command}: no line, or several: {done.stderr[-500:]}")
    if left := [*temporary.iterdir(), *here.iterdir()]:
        raise HarmError(f"{command}: left {left[0]}")
    if _seal(bag.parent) != before:
        raise HarmError(f"{command}: changed the bag, or something beside it")
    return done.exit_code, done.output
