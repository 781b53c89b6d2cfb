# SPDX-License-Identifier: Apache-2.0
"""Hostile files: damage to valid ones, the same every time, and what longer runs of benchmarks/fuzz.py have found."""

import contextlib
import os
import re
import sqlite3
import struct

import fuzz_targets as fuzz
import numpy as np
import pytest
import zstandard
from bags import EMPTY, FIRST, HEADER, SCHEMA, bag_writer, channel, chunk, chunk_index, mcap, record, statistics, text
from fuzz_targets import CUT, TARGETS
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import assert_refused
from mcap.writer import MCAP0_MAGIC

from lathe_machine.control import memory_file
from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.check import check
from lathe_rc.bag.reading import metadata
from lathe_rc.bag.reading.limits import MOST_BYTES
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.storage import Batch
from lathe_rc.bag.reading.stream import Feeder
from lathe_rc.bag.reading.unpacking import unpack
from lathe_rc.bag.repairing.salvage import Salvage
from lathe_rc.errors import InputError, LatheError, shown


@contextlib.contextmanager
def refused(said):
    """A refusal that says so, in one line."""
    with pytest.raises(InputError, match=said) as found:
        yield
    assert len(str(found.value).splitlines()) == 1


BOMB = zstandard.compress(bytes(MOST_BYTES + 1))


EACH = [pytest.param(name, marks=pytest.mark.system) if TARGETS[name].slow else name for name in TARGETS]


@pytest.mark.parametrize("name", EACH)
def test_what_is_valid_is_read(name):
    for data in TARGETS[name].seeds():
        TARGETS[name].read(data)


@pytest.mark.parametrize("name", EACH)
def test_damage_is_refused_in_a_line(name):
    @settings(max_examples=2 if TARGETS[name].slow else 30)
    @given(st.randoms(use_true_random=False))
    def refuse(random):
        TARGETS[name].read(TARGETS[name].damaged(random))

    refuse()


# ---- memories


def test_memory_that_is_a_pipe_or_far_too_long_is_refused_unread(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    assert_refused(lambda: memory_file.load(tmp_path / "pipe", 64, 32), "not a file")
    with (tmp_path / "long").open("wb") as file:
        file.truncate(2**40)
    assert_refused(lambda: memory_file.load(tmp_path / "long", 64, 32), "larger than any memory")


# ---- bags

STATISTICS = statistics()
ENDLESS = b"a: &a [{x: 1}]\n" + b"".join(b"%c: &%c {<<: [*%c, *%c]}\n" % (n, n, n - 1, n - 1) for n in range(98, 122))


def channels(count, qos):
    return b"".join(channel(qos, number) for number in range(count))


def indexed(count, size):
    """Empty chunks, and a summary that says how large they are unpacked."""
    one = len(chunk())
    places = [chunk_index(FIRST + number * one, one, size=size) for number in range(count)]
    return count * chunk(), SCHEMA + statistics(count) + channel() + b"".join(places)


@pytest.mark.parametrize(
    ("data", "summary", "said"),
    [
        (chunk(size=MOST_BYTES, packed=BOMB), b"", "does not unpack to the"),
        (chunk(packed=b"x" * 20), b"", "chunk at byte"),
        (b"", SCHEMA + STATISTICS + struct.pack("<BQ", 13, 2**63), "cut off at byte"),
        (b"", SCHEMA + STATISTICS + struct.pack("<BQ", 13, 2**32), "cut off at byte"),
        (b"", SCHEMA + STATISTICS + channels(600, b"x" * 2000), "characters of quality of service"),
        (b"", SCHEMA + STATISTICS + channels(5000, b""), "more than 4096 topics"),
        (b"", SCHEMA + STATISTICS + 1000 * SCHEMA + record(11, bytes(2**20 + 1)), "record of 1048577 B at byte"),
        (b"", SCHEMA + STATISTICS + chunk_index(2**63, 100), "none can be"),
        (chunk(), SCHEMA + STATISTICS + 2 * chunk_index(FIRST, len(chunk())), "two chunks at byte"),
        (*indexed(1, 2**40), "none can be"),
        (chunk(), SCHEMA + STATISTICS + chunk_index(FIRST, len(chunk()), packed=2**62), "none can be"),
        (*indexed(3, 2**26), "chunks of the same time"),
        (chunk(packed=zstandard.compress(b"") * 10_000, size=0), b"", "B that unpack to 0; no compression does"),
        (*indexed(40, MOST_BYTES), "unpacks to more than 1024 times its size"),
        (chunk(EMPTY * (2**20 + 10000)), b"", "a message for each of its bytes"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_index_that_would_cost_memory_or_time_is_refused(tmp_path, monkeypatch, data, summary, said):
    monkeypatch.setattr("lathe_rc.bag.reading.source.MOST_OPEN", 2**27)
    with refused(said):
        check(mcap(tmp_path / "bad.mcap", data, summary))


@pytest.mark.parametrize(
    "data",
    [
        chunk(packed=zstandard.compress(bytes(50_000_000)), size=1000),
        chunk(size=MOST_BYTES + 1),
        chunk(packed=b"x" * 30, size=30, compression=b""),
        chunk(struct.pack("<BQ", 5, 2**60) + bytes(22)),
        chunk(record(5, struct.pack("<HIQQ", 77, 0, 0, 0))),
        record(4, struct.pack("<HHI", 1, 99, 2**31)),
        record(3, struct.pack("<HI", 1, 2**32 - 1) + b"name"),
        record(12, struct.pack("<II", 2**31, 5)),
        record(6, b""),
        record(5, b""),
        record(0, b"") + record(255, b"?" * 100),
    ],
)
def test_hostile_files_without_an_end_are_refused_in_a_line(tmp_path, data):
    file = tmp_path / "hostile.mcap"
    file.write_bytes(MCAP0_MAGIC + HEADER + data)
    with refused(re.escape(f"{file}: not a readable bag (")):
        check(file)
    assert list(Salvage(file)) == []


@pytest.mark.parametrize("qos", [ENDLESS, b"[" * 100_000, b"a: b: c", b"? [a]"])
@pytest.mark.parametrize("place", ["index", "file", "chunk"])
def test_quality_of_service_that_cannot_be_read_costs_no_message(tmp_path, qos, place):
    announced = SCHEMA + channel(qos)
    summary = announced + STATISTICS if place == "index" else b""
    data = {"index": b"", "file": announced + EMPTY, "chunk": chunk(announced + EMPTY)}[place]
    with BagSource(mcap(tmp_path / "odd.mcap", data, summary)) as source:
        assert sum(1 for _ in source.messages()) == (place != "index")
        assert source.topics["/t"].qos == ()
        assert "/t: quality of service that cannot be read (offered_qos_profiles: " in source.contradictions[0]


@pytest.mark.parametrize("length", [2**33, 2**56])
def test_header_that_is_longer_than_its_file_is_refused_unread(tmp_path, length):
    path = mcap(tmp_path / "bad.mcap", b"", SCHEMA + STATISTICS)
    data = bytearray(path.read_bytes())
    data[9:17] = struct.pack("<Q", length)
    path.write_bytes(data)
    with refused("cut off at byte 8"):
        check(path)


def test_times_of_an_index_are_not_added_up_in_memory(tmp_path):
    """A chunk of 8 million messages comes in batches."""
    with BagSource(mcap(tmp_path / "many.mcap", chunk(SCHEMA + channel() + EMPTY * 100_000))) as source:
        assert sum(1 for _ in source.messages()) == 100_000
    writer = bag_writer(tmp_path / "indexed", "/joints", messages.JOINTS, 2**23)
    for number in range(100_000):
        writer.write("/joints", number, b"\0\1\0\0")
    writer.close()
    with BagSource(tmp_path / "indexed") as source:
        lengths = [len(batch) for batch in source.batches()]
    assert sum(lengths) == 100_000
    assert max(lengths) <= 2**14


def test_messages_that_never_meet_their_blocks_are_not_kept_for_ever():
    event = messages.store().types[messages.EVENT](messages.header(0, 1), "run", "/tool", 0, "begin")
    late = Batch.of(("/events", 2**62, messages.encode(messages.EVENT, event)))
    alone = Feeder({"/events": messages.EVENT}, [], 64)
    for _ in range(10):
        alone.add(late)
    assert not alone._sparse["/events"]
    waiting = Feeder({"/events": messages.EVENT, "/tool": messages.TOOL}, [], 64)
    waiting._sparse["/events"] = [(2**62, {})] * 2**18
    with pytest.raises(LatheError, match="without the blocks of their time"):
        waiting.add(late)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (chunk(chunk(SCHEMA)), "a chunk in the chunk"),
        (SCHEMA + channel(ENDLESS), "YAML aliases"),
        (SCHEMA + channel(b"a: b: c"), "not YAML"),
        (record(3, struct.pack("<H", 1) + text(b"a\nb") + text(b"") + text(b"")) + channel(b""), "name 'a.nb'"),
        (record(12, text(b"lathe_rc") + text(text(b"k") + text(b"x" * 2**24))), "characters of texts and definitions"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_would_cost_memory_is_not_saved_either(tmp_path, data, said):
    salvage = Salvage(mcap(tmp_path / "bad.mcap", data))
    assert list(salvage) == []
    assert said in "".join(salvage.damage).replace("\\n", ".n")


def test_damage_is_counted_beyond_what_is_told(tmp_path):
    salvage = Salvage(mcap(tmp_path / "bad.mcap", 3000 * (record(5, b"") + SCHEMA + SCHEMA)))
    assert list(salvage) == []
    assert len(salvage.damage) == 1000
    assert salvage.lost_bytes == 3000 * len(record(5, b""))


# ---- the folder around a bag


def folder(path, *, change=lambda metadata: metadata, word=b""):
    """A folder of the first seed that has a word in it, with other metadata."""
    metadata, *rest = next(seed for seed in TARGETS["folder"].seeds() if word in seed).split(CUT, 2)
    fuzz.write_folder(path, CUT.join([change(metadata), *rest]))
    return path


def named(metadata, name):
    return re.sub(rb'"?/where"?', lambda _: name, metadata)


LAUGHS = b"a: &a [x, x]\n" + b"".join(b"%c: &%c [*%c, *%c]\n" % (n, n, n - 1, n - 1) for n in range(98, 123))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: LAUGHS + m, "YAML aliases"),
        (lambda m: m + b"\nx: " + b"[" * 200_000, "nested deeper"),
        (lambda _: b"null", "no rosbag2_bagfile_information"),
        (lambda _: b"[]", "no rosbag2_bagfile_information"),
        (lambda m: m.replace(b"relative_file_paths", b"files"), "no relative_file_paths"),
        (lambda m: m + b"\n" * 2**24, "allowed: up to 16777216 B"),
        (lambda m: named(m, b'"/wh\\nere"'), "allowed: up to 1024 characters that print"),
        (lambda m: named(m, b'""'), "name ''"),
        (lambda m: m.replace(b"20", b"many"), "'many' where a whole number belongs"),
        (lambda m: b"\xff" + m, "codec can't decode"),
        (lambda m: b"\x01" + m, "not YAML"),
    ],
)
def test_metadata_that_nobody_can_use_are_refused(tmp_path, change, said):
    with refused(said):
        check(folder(tmp_path / "bag", change=change))


def database(path, *statements):
    bag = folder(path, word=b"SQLite format")
    with sqlite3.connect(bag / "bag.db3") as base:
        for statement in statements:
            base.execute(statement)
    base.close()
    return bag


COUNTING = """CREATE VIEW message_definitions AS
    WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n"""


@pytest.mark.parametrize(
    ("statements", "said"),
    [
        (("DROP TABLE message_definitions", COUNTING), "view 'message_definitions'"),
        (("ALTER TABLE topics ADD COLUMN x GENERATED ALWAYS AS (zeroblob(1000000000))",), "table 'topics'"),
        (("CREATE VIRTUAL TABLE x USING fts5(y)",), "table 'x'"),
        (("UPDATE messages SET data = zeroblob(134217729) WHERE id = 1",), "a message of 134217729 B"),
    ],
)
def test_database_that_answers_more_than_it_holds_is_refused(tmp_path, statements, said):
    bag = database(tmp_path / "bag", *statements)
    assert_refused(lambda: check(bag), said)
    salvage = Salvage(bag)
    assert list(salvage) == []
    assert said in salvage.damage[0]


def test_file_that_is_packed_twice_or_behind_what_zstd_skips_is_looked_at(tmp_path):
    skipped = b"\x50\x2a\x4d\x18" + struct.pack("<I", 4) + b"skip"
    inside = mcap(tmp_path / "bad.mcap", b"", SCHEMA + STATISTICS + chunk_index(2**63, 100)).read_bytes()
    for content, said in ((skipped + zstandard.compress(inside), "none can be"), (zstandard.compress(BOMB), "twice")):
        (tmp_path / "x.mcap").write_bytes(content)
        assert_refused(lambda: BagSource(tmp_path / "x.mcap"), said)


def test_names_and_numbers_of_a_bag_are_what_they_should_be():
    for name in ("", "a\nb", "\x1b[2J", "x" * 1025, 5, None, "\ud800"):
        with pytest.raises(ValueError, match="characters that print"):
            metadata.check_name(name)
    with pytest.raises(ValueError, match="does not unpack"):
        unpack("zstd", BOMB, 1000)
    assert shown("\x1b[2Ja\nb") == "\ufffd[2Ja"


# ---- what a bag says of itself


def test_run_of_a_bag_writes_to_no_file_that_the_bag_names(tmp_path):
    """A bag could name any file of the reader's as the memory to be saved."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / "files").mkdir()
    scenario = f"learning_controller: {{ros__parameters: {{memory_file: {precious}, run_id: r}}}}"
    found = provenance.scenario_of({provenance.SCENARIO: scenario}, tmp_path / "files")
    named = found.nodes["learning_controller"].memory_file
    memory_file.save(type(precious)(named), np.zeros(4), 4)
    assert precious.read_text() == "mine"


@pytest.mark.parametrize(
    ("about", "said"),
    [
        ({f"{provenance.FILE}tool.profile_file": "a"}, "is not base64"),
        ({f"{provenance.FILE}tool.profile_file": "\u00e9"}, "is not base64"),
        ({provenance.SCENARIO: "\ud800"}, "not a text file"),
    ],
)
def test_texts_that_are_no_scenario_are_refused(tmp_path, about, said):
    with refused(said):
        provenance.scenario_of({provenance.SCENARIO: "tool: {ros__parameters: {seed: 1}}", **about}, tmp_path)
