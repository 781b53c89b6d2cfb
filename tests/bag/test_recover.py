# SPDX-License-Identifier: Apache-2.0
"""Bags that are cut off, broken, hostile or made by others: nothing that is whole is lost, nothing crashes."""

import json
import shutil
import sqlite3
import struct
import threading
from concurrent.futures import Future
from random import Random

import numpy as np
import pytest
import yaml
import zstandard
from bags import MODES, bag_writer, lathe, mcap_writer, read_by_others, storage_of, strange_bag
from cells import files_up_to, scenario
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_damage import (
    PER_CHUNK,
    check_damage,
    chunk_ends,
    chunks_of,
    flipped,
    flips,
    plain_file,
    saved_of,
    small_bag,
    structured,
)
from mcap_damage import records_of as record_places
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from lathe_rc import harness, messages
from lathe_rc.bag.check import check, recorded, write_digests
from lathe_rc.bag.reading.limits import MOST_BYTES
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.repairing.recover import recover
from lathe_rc.bag.writing.mcap_file import McapFile
from lathe_rc.blocks.wire import Encoder
from lathe_rc.errors import InputError, LatheError, LossyRunError

PLUGINS = pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    path = tmp_path_factory.mktemp("turned") / "bag"
    harness.run(scenario(spindle_encoder={"revolutions": 20.0}, recorder={"chunk_size": 65536}), bag=path)
    return path


@pytest.mark.parametrize(("plugin", "mode"), MODES, ids=lambda value: value.name)
def test_bags_of_others_are_read_checked_and_recovered(tmp_path, plugin, mode):
    """Cut off anywhere, they give what is whole."""
    bag = tmp_path / "strange"
    sent = strange_bag(bag, plugin, mode)
    with BagSource(bag) as source:
        assert list(source.messages()) == sent
        assert {topic: said.count for topic, said in source.topics.items()} == {"/where": 400, "/said": 200}
    assert check(bag).exit_code == 0
    assert recover(bag, tmp_path / "new").saved == len(sent)
    assert read_by_others(tmp_path / "new") == sent
    file = storage_of(bag)
    whole = file.read_bytes()
    for length in np.random.default_rng(3).integers(0, len(whole), 10):
        file.write_bytes(whole[:length])
        recover(bag, tmp_path / f"cut{length}")
        assert set(read_by_others(tmp_path / f"cut{length}")) <= set(sent)


def test_hundreds_of_cuts_lose_no_more_than_the_cut_chunk(tmp_path):
    data = small_bag(tmp_path / "bag", chunks=20)
    ends = [end for _, end in chunks_of(data)]
    for number, length in enumerate(np.random.default_rng(1).integers(0, len(data), 300)):
        found, saved = saved_of(tmp_path / "cut.mcap", data[:length])
        expected = PER_CHUNK * sum(end <= length for end in ends)
        assert len(saved) == expected
        assert found.damage
        if number % 100 == 0:
            assert recover(tmp_path / "cut.mcap", tmp_path / f"new{number}").saved == expected


def test_a_broken_chunk_in_the_middle_costs_that_chunk_alone(turned, tmp_path):
    bag = shutil.copytree(turned, tmp_path / "bag")
    data = storage_of(bag).read_bytes()
    ends = chunk_ends(data)
    storage_of(bag).write_bytes(flipped(data, (ends[4][0] + ends[5][0]) // 2, 0x10))
    assert lathe("bag", "check", bag).exit_code == 2
    found = lathe("bag", "recover", bag, "-o", tmp_path / "new", "--json")
    assert found.exit_code == 3
    assert json.loads(found.stdout)["saved"] == ends[-1][1] - (ends[5][1] - ends[4][1])
    assert "samples are missing before sample" in lathe("bag", "check", tmp_path / "new").stdout


def test_what_is_clean_is_said_to_be_clean(turned, tmp_path):
    """And another digest than the recorded one is wrong."""
    told = json.loads(lathe("bag", "check", turned, "--json").stdout)
    assert told["digest"] == recorded(turned)
    assert told["digests_compared"] == len(told["digest"]) == 9
    again = lathe("bag", "recover", turned, "-o", tmp_path / "new")
    assert again.exit_code == 0, again.stdout
    assert check(tmp_path / "new").digests == told["digest"]
    write_digests(tmp_path / "new", told["digest"] | {"/tool": "0" * 64})
    found = lathe("bag", "check", tmp_path / "new")
    assert (found.exit_code, "/tool: digest " in found.stdout) == (1, True)


INF_AT_7 = np.where(np.arange(64) == 7, np.inf, 0.0)


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        (lambda k, b: None if k == 4 else b, 3, "/a/command: 64 samples are missing before sample 320"),
        (lambda k, b: (b[0] - 64, *b[1:]) if k == 5 else b, 1, "/a/command: goes back from sample 320 to 256"),
        (lambda k, b: (b[0], b[1] + INF_AT_7, b[2]) if k == 2 else b, 1, "position = inf at sample 135"),
        (lambda _, b: (*b[:2], False), 3, "/a/command: no last block"),
        (lambda k, b: (*b[:2], k == 3 or b[2]), 1, "/a/command: goes on at sample 256 after its last block"),
    ],
)  # fmt: skip
def test_each_flaw_is_named(tmp_path, change, code, said):
    encoder = Encoder(messages.COMMAND, "run", "/a", 15_625)
    writer = bag_writer(tmp_path / "bag", "/a/command", messages.COMMAND)
    for number in range(10):
        if block := change(number, (64 * number, np.full(64, float(number)), number == 9)):
            first, samples, last = block
            stamp, data = encoder.encode(first, {"position": samples}, last=last, companions=0)
            writer.write("/a/command", stamp, data)
    writer.close()
    found = lathe("bag", "check", tmp_path / "bag")
    assert found.exit_code == code
    assert said in found.stdout


@pytest.mark.parametrize("flushed", [True, False])
def test_what_the_disk_does_not_take_is_told_with_the_chunk_or_flush(tmp_path, flushed):
    """And the bag says of itself what is in it: all before, nothing after."""
    writer = bag_writer(tmp_path / "bag", "/said", messages.EVENT)
    told = 0

    def fill():
        nonlocal told
        while told < 1000:
            writer.write("/said", 10**9 + told, bytes(1000))
            if flushed:
                writer.flush()
            told += 1

    why = r"bag: cannot write \(File too large\); what was recorded before is readable"
    with files_up_to(2**19), pytest.raises(LatheError, match=why):
        fill()
    writer.write("/said", 2 * 10**9, bytes(1000))
    with pytest.raises(LatheError, match=why):
        writer.close()
    with AnyReader([tmp_path / "bag"]) as found:
        stamps = [stamp for _, stamp, _ in found.messages()]
        assert found.message_count == len(stamps)
    assert stamps == list(range(10**9, 10**9 + len(stamps)))
    assert len(stamps) == told if flushed else 0 < told - len(stamps) <= 20


def test_an_interrupt_while_a_chunk_is_written_loses_nothing(tmp_path, monkeypatch):
    """The bag is closed after that chunk, not beside it."""
    waits, waited, write_chunk, result = 0, threading.Event(), McapFile._write_chunk, Future.result

    def late(*args):
        waited.wait(10.0)
        write_chunk(*args)

    def interrupted_once(self):
        nonlocal waits
        waits += 1
        if waits == 1:
            raise KeyboardInterrupt
        waited.set()
        return result(self)

    writer = bag_writer(tmp_path / "bag", "/said", messages.EVENT)
    writer.write("/said", 10**9, bytes(1000))
    monkeypatch.setattr(McapFile, "_write_chunk", late)
    monkeypatch.setattr(Future, "result", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        writer.flush()
    writer.close()
    with AnyReader([tmp_path / "bag"]) as found:
        assert [stamp for _, stamp, _ in found.messages()] == [10**9]
        assert found.message_count == 1


HINT = "; lathe bag recover saves the rest"


def unreadable(path, make):
    """Folders and files that are no readable bag."""
    if make in ("nothing there", "empty folder"):
        if make == "empty folder":
            path.mkdir()
        return path
    plugin = StoragePlugin.MCAP if "MCAP" in make else StoragePlugin.SQLITE3
    strange_bag(path, plugin, count=6000 if "page" in make else 600)
    file = storage_of(path)
    whole = file.read_bytes()
    if "cut" in make:
        file.write_bytes(whole[:20000])
    elif "page" in make:
        file.write_bytes(whole[:200_704] + bytes(4096) + whole[204_800:])
    elif "junk" in make:
        file.write_bytes(b"junk" * 100)
    else:
        (path / "metadata.yaml").write_text("}")
    return file if "alone" in make else path


@pytest.mark.parametrize(
    ("make", "said"),
    [
        ("nothing there", "(there is no such folder or file)"),
        ("empty folder", "(no metadata.yaml in that folder, nor a .mcap or .db3 file)"),
        ("SQLite, broken metadata", f"(metadata.yaml: not YAML in line 1){HINT}"),
        ("MCAP, junk", "(bag.mcap: not an MCAP or SQLite file)"),
        ("MCAP, cut", "(bag.mcap: cut off at byte 43)"),
        ("SQLite, cut", "(bag.db3: database disk image is malformed)"),
        ("SQLite, lost page, alone", f"(bag.db3: database disk image is malformed){HINT}"),
    ],
)
def test_what_cannot_be_read_is_the_same_fault_for_all_with_a_hint_where_recover_helps(tmp_path, make, said):
    """And `info` tells what can be read."""
    bag = unreadable(tmp_path / "bag", make)
    for command in (("bag", "info"), ("bag", "check"), ("measure",)):
        refused = lathe(*command, bag)
        if command == ("bag", "info") and HINT in said:
            assert refused.exit_code == 3
            assert refused.stderr.splitlines()[-1] == said.removesuffix(HINT)[1:-1]
            assert "/where │ Point  │" in refused.stdout
            continue
        assert refused.stderr.startswith(f"lathe: {bag}: not a readable bag (")
        assert refused.stderr.endswith(f"{said}\n")
        assert refused.exit_code == 2
    recovered = lathe("bag", "recover", bag, "-o", tmp_path / "new", "--json")
    saved = json.loads(recovered.stdout)["saved"] if recovered.exit_code != 2 else 0
    assert bool(saved) == (HINT in said), recovered.stderr
    assert recovered.exit_code == (2 if "there" in said or "folder" in said else 0 if "metadata" in make else 3)
    assert (tmp_path / "new").exists() == (recovered.exit_code != 2)


def records_of(path):
    """Profile, channels with their schemas, messages, metadata and attachments of an MCAP file, by another library."""
    profile, schemas, channels, messages, others = "", {0: None}, {}, [], []
    for record in StreamReader(path.open("rb"), validate_crcs=True).records:
        match record:
            case Header():
                profile = record.profile
            case Schema():
                schemas[record.id] = (record.name, record.encoding, record.data)
            case Channel():
                metadata = tuple(record.metadata.items())
                channels[record.id] = (record.topic, record.message_encoding, metadata, schemas[record.schema_id])
            case Message():
                times = record.log_time, record.publish_time
                messages.append((channels[record.channel_id], record.sequence, *times, record.data))
            case Attachment() | Metadata() if not getattr(record, "name", "").startswith(("rosbag2", "lathe_rc")):
                others.append(record)
    return profile, set(channels.values()), messages, others


KINDS = {
    "CRLF": ("my_msgs/msg/Odd", "ros2msg", b"int32 A=1\r\nint32 x\r\n", "cdr", {}),
    "CRLF, hash": ("my_msgs/msg/Odd", "ros2msg", b"int32 x\r\n", "cdr", {"topic_type_hash": "RIHS01_" + "0" * 64}),
    "wstring": ("my_msgs/msg/Odd", "ros2msg", b"wstring w\nint32 x\n", "cdr", {}),
    "IDL, hash": ("my_msgs/msg/I", "ros2idl", b"module my_msgs {};", "cdr", {"topic_type_hash": "RIHS01_" + "1" * 64}),
    "OMG IDL, no package": ("Cfg", "omgidl", b"struct Cfg { long x; };", "cdr", {}),
    "no definition": ("my_msgs/msg/Odd", "", b"", "cdr", {}),
    "empty definition": ("my_msgs/msg/Odd", "ros2msg", b"", "cdr", {}),
    "no text": ("my_msgs/msg/Odd", "ros2msg", b"\xff\0", "cdr", {}),
    "code": ("my_msgs/msg/Odd", "ros2msg", b"string X=\"'''+__import__('os').abort()+'''\"\n", "cdr", {}),
    "JSON": ("Odo", "jsonschema", b'{"type": "object"}', "json", {}),
    "protobuf": ("foxglove.Log", "protobuf", b"\n\x03abc", "protobuf", {}),
    "no name": ("", "", b"", "cdr", {}),
    "ROS 1": ("std_msgs/String", "ros1msg", b"string data\n", "ros1", {"md5sum": "99", "latching": "1"}),
    "no schema": (None, "json", {}),
    "no schema, CDR": (None, "cdr", {}),
    "partial QoS": ("std_msgs/msg/String", "ros2msg", b"string data\n", "cdr", {"offered_qos_profiles": "- depth: 10"}),
    "map as QoS": ("std_msgs/msg/String", "ros2msg", b"string data\n", "cdr", {"offered_qos_profiles": "depth: 1"}),
    "no QoS": ("std_msgs/msg/String", "ros2msg", b"string data\n", "cdr", {"offered_qos_profiles": "a: b: c"}),
}  # fmt: skip


@pytest.mark.parametrize("profile", ["ros2", "ros1", ""])
def test_copies_what_it_need_not_understand(tmp_path, profile):
    """Schemas, channels, message encodings, sequence numbers, both times, attachments and metadata: to the byte."""
    file = tmp_path / "foreign.mcap"
    with mcap_writer(file, profile) as writer:
        writer.add_attachment(create_time=1, log_time=2, name="calibration", media_type="text/csv", data=b"1,2\n")
        writer.add_metadata("vehicle", {"serial": "\xb5 7"})
        for number, (name, kind) in enumerate(KINDS.items()):
            *schema, encoding, metadata = kind
            known = writer.register_schema(*schema) if schema != [None] else 0
            for topic in (f"/topic{number}", "/shared"):
                channel = writer.register_channel(topic, encoding, known, metadata | {"kind": name})
                writer.add_message(channel, 10**9 + number, name.encode(), 10**9 - number, sequence=number)
    found = recover(file, tmp_path / "new")
    assert (found.saved, found.lossy) == (2 * len(KINDS), False)
    assert records_of(storage_of(tmp_path / "new")) == records_of(file)
    assert recover(tmp_path / "new", tmp_path / "again").saved == found.saved


def test_a_hash_of_zeros_is_not_stated_in_the_metadata(tmp_path):
    """A middleware that knows no hash of a type says so; rosbags would compare the zeros with the type's own hash."""
    file, idl = tmp_path / "foreign.mcap", b"module my_msgs { module msg { struct Odd { int32 x; }; }; };"
    with mcap_writer(file) as writer:
        schema = writer.register_schema("my_msgs/msg/Odd", "ros2idl", idl)
        channel = writer.register_channel("/odd", "cdr", schema, {"topic_type_hash": "RIHS01_" + "0" * 64})
        writer.add_message(channel, 1, b"\0\1\0\0\7\0\0\0", 1)
    recover(file, tmp_path / "new")
    assert read_by_others(tmp_path / "new") == [("/odd", 1, b"\0\1\0\0\7\0\0\0")]


LOGS = {
    "whole": lambda log: log,
    "cut": lambda log: log[:-5000],
    "flipped": lambda log: flipped(log, 50_000),
    "salt flipped": lambda log: flipped(log, 17),
    "another file": lambda _log: b"no log at all" * 500,
    "not written to the end": lambda log: log,
}


@pytest.mark.parametrize("kind", LOGS)
def test_what_a_write_ahead_log_does_not_give_is_told(tmp_path, kind):
    """The bytes of a log that give no message count as lost; a log of whole transactions loses nothing.

    The recorder was killed: some messages are in the log alone. Neither file is touched.
    """
    bag = tmp_path / "killed"
    sent = strange_bag(tmp_path / "bag", StoragePlugin.SQLITE3, count=30)
    base = sqlite3.connect(tmp_path / "bag" / "bag.db3", isolation_level=None)
    base.executescript(
        "PRAGMA synchronous=OFF; PRAGMA journal_mode=WAL; PRAGMA wal_autocheckpoint=0; PRAGMA cache_size=1"
    )
    for number in range(20):
        base.execute(
            "INSERT INTO messages SELECT 31 + ?, topic_id, timestamp + 90000, data FROM messages WHERE id = 1",
            (number,),
        )
        sent.append((sent[0][0], sent[0][1] + 90_000, sent[0][2]))
    if kind == "not written to the end":
        base.executescript("BEGIN; UPDATE messages SET data = zeroblob(5000)")
    bag.mkdir()
    shutil.copy(tmp_path / "bag" / "bag.db3", bag)
    (bag / "bag.db3-wal").write_bytes(LOGS[kind]((tmp_path / "bag" / "bag.db3-wal").read_bytes()))
    base.close()
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    lost = kind != "whole"
    found = recover(bag, tmp_path / "new")
    assert (found.lossy, bool(found.lost_bytes)) == (lost, lost)
    assert found.saved == 50 if kind in ("whole", "not written to the end") else 30 <= found.saved < 50
    assert read_by_others(tmp_path / "new") == sent[: found.saved]
    with BagSource(bag, partial=True) as source:
        assert list(source.messages()) == sent[: found.saved]
    checked = lathe("bag", "check", bag)
    told = f"{found.lost_bytes} B of its write-ahead log are broken, or were not written to the end"
    assert f"(bag.db3: {told}); lathe bag recover saves the rest" in checked.stderr or not lost
    assert (checked.exit_code, lathe("bag", "info", bag).exit_code) == ((2, 3) if lost else (1, 0))
    assert lost or checked.stdout.startswith("no metadata.yaml in that folder: bag.db3 alone is read")
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == before


@pytest.fixture
def broken_off(tmp_path):
    """A database that was being written, with its rollback journal; and what it held before."""
    sent = strange_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    base = sqlite3.connect(tmp_path / "bag" / "bag.db3", isolation_level=None)
    base.executescript("PRAGMA cache_size=1; BEGIN; UPDATE messages SET timestamp = 7, data = zeroblob(3000)")
    (tmp_path / "killed").mkdir()
    for file in (tmp_path / "bag").glob("*.db3*"):
        shutil.copy(file, tmp_path / "killed")
    base.close()
    return tmp_path / "killed" / "bag.db3-journal", sent


def test_a_write_that_was_broken_off_is_taken_back(broken_off, tmp_path):
    journal, sent = broken_off
    with BagSource(journal.parent) as source:
        assert list(source.messages()) == sent
    assert recover(journal.parent, tmp_path / "new").saved == len(sent)


def test_a_journal_that_names_a_further_file_is_refused_and_the_file_stays(broken_off, tmp_path):
    """SQLite would look for the file, and remove it."""
    journal, _ = broken_off
    named = tmp_path / "named"
    named.write_bytes(b"mine")
    name = bytes(named)
    tail = struct.pack(">I", 0) + name + struct.pack(">II", len(name), sum(name)) + b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
    journal.write_bytes(journal.read_bytes() + tail)
    with pytest.raises(InputError, match="it names a further journal"):
        BagSource(journal.parent)
    assert recover(journal.parent, tmp_path / "new").lossy
    assert named.read_bytes() == b"mine"


def test_a_log_that_is_a_link_is_refused(broken_off, tmp_path):
    """A bag reads nothing outside of its folder; a database that the user names by a link has its logs elsewhere."""
    journal, sent = broken_off
    (tmp_path / "linked.db3").symlink_to(journal.with_name("bag.db3"))
    with BagSource(tmp_path / "linked.db3") as source:
        assert list(source.messages()) == sent
    journal.rename(tmp_path / "outside")
    journal.symlink_to(tmp_path / "outside")
    for command in ("info", "check", "recover"):
        refused = lathe("bag", command, journal.parent)
        assert (refused.exit_code, "bag.db3-journal: a link" in refused.stderr) == (2, True)


OVERLAPS = {
    "backwards": ([[90, 95], [40, 60, 80], [0, 50]], {}),
    "nested": ([range(0, 100, 3), range(40, 50)], {"chunk_size": 100}),
    "equal times": ([[0, 0, 5, 5], [0, 5, 5, 10]], {}),
    "touching": ([[0, 5], [5, 10], [10, 10]], {}),
    "unsorted": ([[50, 10, 90, 30, 0], [95, 5, 55]], {"chunk_size": 60}),
    "without chunks": ([[50, 10, 90], [20, 80, 0]], {"use_chunking": False}),
    "an empty one": ([[], [3, 1], [2]], {}),
    "one of years": ([[0, 2**64 - 1], [3, 5], [4]], {}),
}


@pytest.mark.parametrize("kind", OVERLAPS)
def test_files_that_overlap_in_any_way_are_merged_by_time(tmp_path, kind):
    files, options = OVERLAPS[kind]
    path = tmp_path / "bag"
    path.mkdir()
    for number, times in enumerate(files):
        with mcap_writer(path / f"{number}.mcap", **options) as writer:
            channel = writer.register_channel("/x", "cdr", writer.register_schema("my_msgs/msg/X", "", b""))
            for log_ns in times:
                writer.add_message(channel, log_ns, b"%d" % number, log_ns)
    # Of equal times, the order of the files and that within them.
    sent = sorted([(t, b"%d" % n) for n, times in enumerate(files) for t in times], key=lambda said: said[0])
    assert recover(path, tmp_path / "new").saved == len(sent)
    for bag in (path, tmp_path / "new"):
        with BagSource(bag) as source:
            assert [(log_ns, data) for _, log_ns, data in source.messages()] == sent


def test_a_compressed_file_that_a_player_unpacked_beside_is_read_once(tmp_path):
    sent = strange_bag(tmp_path / "bag", StoragePlugin.MCAP, CompressionMode.FILE)
    file = storage_of(tmp_path / "bag")
    file.with_suffix("").write_bytes(zstandard.decompress(file.read_bytes(), max_output_size=2**24))
    assert check(tmp_path / "bag").exit_code == 0
    assert recover(tmp_path / "bag", tmp_path / "new").saved == len(sent)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with BagSource(tmp_path / "bag") as source:
        assert list(source.messages()) == sent


def test_a_file_that_the_metadata_do_not_name_is_told(tmp_path):
    """A recorder that was killed wrote them last before its last file; or a file was renamed."""
    sent = strange_bag(tmp_path / "bag")
    file = storage_of(tmp_path / "bag")
    shutil.copy(file, file.with_name("later.mcap"))
    said = "metadata.yaml does not name later.mcap: not read; lathe bag recover saves its messages too"
    checked = lathe("bag", "check", tmp_path / "bag")
    assert (checked.exit_code, checked.stdout.splitlines()[0]) == (1, said)
    assert recover(tmp_path / "bag", tmp_path / "new").saved == 2 * len(sent)
    file.unlink()
    found = lathe("bag", "info", tmp_path / "bag")
    assert (found.exit_code, "bag.mcap: there is no such file" in found.stderr) == (3, True)
    assert "│      400 │" in found.stdout
    assert "no such file); lathe bag recover saves the rest" in lathe("bag", "check", tmp_path / "bag").stderr


FOREIGN = {
    "ROS 1": (("ros1", ("std_msgs/String", "ros1msg", b"string data")), "std_msgs/String"),
    "protobuf": (("protobuf", ("foxglove.Log", "protobuf", b"\n\x03abc")), "foxglove.Log"),
    "without schema": (("cbor", None), ""),
    "upper case": (("CDR", ("std_msgs/msg/String", "ros2msg", b"string data")), "std_msgs/msg/String"),
    "without a name": (("", ("", "", b"")), ""),
    "of no type": (("cdr", None), ""),
    "two types": (("cdr", ("std_msgs/msg/Int32", "ros2msg", b"int32 data")), "std_msgs/msg/Int32"),
}


@pytest.mark.parametrize("topic", ["/other", "/said"])
@pytest.mark.parametrize("kind", FOREIGN)
def test_what_is_not_of_ros_2_hides_nothing_of_it(tmp_path, kind, topic):
    """Beside a topic of ROS 2, or under its name; alone, it is refused as what it is."""
    (encoding, schema), name = FOREIGN[kind]
    for alone in (False, True):
        file = tmp_path / f"{alone}.mcap"
        with mcap_writer(file, "another") as writer:
            known = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            text = () if alone else ((writer.register_channel("/said", "cdr", known), b"\0\1\0\0\1\0\0\0\0"),)
            number = writer.register_schema(*schema) if schema else 0
            for channel, data in (*text, (writer.register_channel(topic, encoding, number), b"?")):
                writer.add_message(channel, 10**9, data, 10**9)
        found = recover(file, tmp_path / f"new {alone}")
        assert (found.saved, found.lossy) == (2 - alone, False)
        read = alone or topic == "/other" if kind == "two types" else False
        checked = lathe("bag", "check", file)
        assert checked.exit_code == (2 if alone and not read else 0)
        told = f"{topic} {name}".strip() + ", 1 messages "
        assert read or (f"no topic that can be read ({told}" if alone else f"not read: {told}") in checked.output


def test_topics_in_other_serializations_are_named_and_copied_and_the_rest_is_read(tmp_path):
    sent = strange_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    with sqlite3.connect(tmp_path / "bag" / "bag.db3") as database:
        database.execute("UPDATE topics SET serialization_format = 'xdr' WHERE name = '/said'")
    with BagSource(tmp_path / "bag") as source:
        assert list(source.messages()) == [message for message in sent if message[0] != "/said"]
    said = "not read: /said std_msgs/msg/String, 200 messages serialized as 'xdr', not 'cdr'"
    for command in ("info", "check"):
        found = lathe("bag", command, tmp_path / "bag")
        assert (found.exit_code, said in found.stdout) == (0, True)
    assert lathe("bag", "recover", tmp_path / "bag", "-o", tmp_path / "new").exit_code == 0
    _, channels, copied, _ = records_of(storage_of(tmp_path / "new"))
    assert {channel[:2] for channel in channels} == {("/said", "xdr"), ("/where", "cdr")}
    assert [(channel[0], log_ns, data) for channel, _, log_ns, _, data in copied] == sent


@PLUGINS
def test_the_files_count_where_the_metadata_contradict_them(tmp_path, plugin):
    """And it is told: by `info` on stderr, by `check` as wrong."""
    path = tmp_path / "bag"
    sent = strange_bag(path, plugin)
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    told = metadata["rosbag2_bagfile_information"]
    told["starting_time"]["nanoseconds_since_epoch"] += 100_000
    told["topics_with_message_count"][1]["message_count"] = 20
    (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    with BagSource(path) as source:
        assert list(source.messages()) == sent
        assert (source.first_ns, source.last_ns) == (sent[0][1], sent[-1][1])
        assert source.topics["/said"].count == 200
    said = [
        "metadata.yaml says first message at 1000100000 ns; the files: 1000000000",
        "metadata.yaml says last message at 1000699000 ns; the files: 1000599000",
        "metadata.yaml says 20 messages of /said; the files: 200",
    ]
    assert lathe("bag", "info", path).stderr.splitlines() == said
    assert json.loads(lathe("bag", "info", path, "--json").stdout)["contradictions"] == said
    checked = lathe("bag", "check", path)
    assert checked.stdout.splitlines()[:3] == said
    assert checked.exit_code == 1


def test_what_unpacks_to_gigabytes_is_refused(tmp_path, monkeypatch):
    """A message, or a file that is compressed as a whole."""
    strange_bag(tmp_path / "messages", StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    strange_bag(tmp_path / "file", StoragePlugin.SQLITE3, CompressionMode.FILE)
    bomb = zstandard.compress(bytes(MOST_BYTES + 1))
    with sqlite3.connect(storage_of(tmp_path / "messages")) as database:
        database.execute("UPDATE messages SET data = ? WHERE id = 1", (bomb,))
    refused = pytest.raises(InputError, match=f"{MOST_BYTES + 1} B when unpacked; allowed: up to {MOST_BYTES}")
    with BagSource(tmp_path / "messages") as source, refused:
        list(source.messages())
    monkeypatch.setattr("lathe_rc.bag.reading.unpacking.MOST_SMALL", 0)
    monkeypatch.setattr("lathe_rc.bag.reading.unpacking.EXPANSION", 1)
    with pytest.raises(InputError, match="unpacks to more than 1 times its size"):
        BagSource(tmp_path / "file")


def test_a_bag_of_a_cell_that_did_not_begin_is_not_clean(tmp_path):
    """It has the state of the cell, and no signals."""
    bag_writer(tmp_path / "bag", "/cell_state", messages.CELL_STATE).close()
    result = lathe("bag", "check", tmp_path / "bag")
    assert result.exit_code == LossyRunError.exit_code, result.output
    assert "no block: the cell of this bag did not begin" in result.output


# --- damage and what is left


@pytest.mark.parametrize("kind", [flips, structured])
def test_damage_costs_no_more_than_the_chunks_that_it_hits(tmp_path, kind):
    """A flipped bit anywhere; wrong lengths, kinds, checksums; holes, cuts. tests/system does more of them."""
    data = small_bag(tmp_path / "bag")
    _, whole = saved_of(tmp_path / "bad.mcap", data)
    for damaged in kind(data, 48, Random(5)):  # noqa: S311
        check_damage(tmp_path / "bad.mcap", whole, damaged)


def test_schemas_and_channels_stand_in_several_chunks(tmp_path):
    """So one flipped byte in the first costs its messages alone, though nothing came behind the last chunk."""
    data = small_bag(tmp_path / "bag")
    chunks = chunks_of(data)
    _, whole = saved_of(tmp_path / "bad.mcap", data)
    for last in (1, 2, 9):
        cut = bytearray(data[: chunks[last][1]])
        cut[chunks[0][1] - 9] ^= 1
        salvage, saved = saved_of(tmp_path / "bad.mcap", bytes(cut))
        assert saved == whole[PER_CHUNK : PER_CHUNK * (last + 1)]
        assert salvage.lossy


@pytest.mark.parametrize("opcode", [Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.METADATA])
def test_a_damaged_index_is_not_clean_and_costs_no_message(tmp_path, opcode):
    data = small_bag(tmp_path / "bag")
    begin = next(begin for found, begin, _ in record_places(data) if found == opcode)
    storage_of(tmp_path / "bag").write_bytes(flipped(data, begin + 2, 4))
    assert lathe("bag", "check", tmp_path / "bag").exit_code in (1, 2)
    found = lathe("bag", "recover", tmp_path / "bag", "-o", tmp_path / "new", "--json")
    assert found.exit_code == 0
    assert json.loads(found.stdout)["saved"] == 10 * PER_CHUNK


@pytest.mark.parametrize("place", ["metadata.yaml", "bag.mcap"])
def test_fewer_messages_than_are_counted_is_lossy(tmp_path, place):
    """Each of the two counts is enough, also if every record is sound."""
    data = small_bag(tmp_path / "bag")
    begin, end = chunks_of(data)[3]
    storage_of(tmp_path / "bag").write_bytes(data[:begin] + data[end:])
    path = tmp_path / "bag" if place == "metadata.yaml" else storage_of(tmp_path / "bag")
    if place == "metadata.yaml":
        storage_of(tmp_path / "bag").write_bytes((data[:begin] + data[end:])[: -len(data) // 10])
    found = lathe("bag", "recover", path, "-o", tmp_path / "new", "--json")
    told = json.loads(found.stdout)
    assert (found.exit_code, told["saved"], told["missing"]) == (3, 9 * PER_CHUNK, PER_CHUNK)
    assert f"{place} counts 400 messages, 40 more than there are" in told["damage"]


def test_messages_outside_of_chunks_are_found_again(tmp_path):
    """Without a checksum of their own; that of the file tells that one may be wrong."""
    file = tmp_path / "plain.mcap"
    data = plain_file(file, 100)
    _, whole = saved_of(file, data)
    begin = [begin for opcode, begin, _ in record_places(data) if opcode == Opcode.MESSAGE][50]
    for place, left in ((begin, 99), (begin + 1, 99), (begin + 5, 98), (begin + 40, 100)):
        salvage, saved = saved_of(file, flipped(data, place, 8))
        assert len(saved) == left
        assert left == 100 or set(saved) < set(whole)
        assert salvage.lossy
        assert f"{file.name}: {left} messages have no checksum of their own; some may be wrong" in salvage.damage


def test_a_broken_page_of_a_database_costs_its_messages(tmp_path):
    sent = strange_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    file = storage_of(tmp_path / "bag")
    data = bytearray(file.read_bytes())
    page = data.index(b"word 300") // 4096 * 4096
    data[page : page + 100] = bytes(100)
    file.write_bytes(data)
    found = recover(tmp_path / "bag", tmp_path / "new")
    assert found.lossy
    assert found.missing == len(sent) - found.saved < 120
    assert set(read_by_others(tmp_path / "new")) < set(sent)


def test_rows_that_are_no_messages_are_told(tmp_path):
    sent = strange_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    with sqlite3.connect(storage_of(tmp_path / "bag")) as base:
        base.execute("UPDATE messages SET topic_id = 77 WHERE id = 1")
        base.execute("UPDATE messages SET timestamp = -1 WHERE id = 2")
        base.execute("UPDATE messages SET data = 'text' WHERE id = 3")
    found = recover(tmp_path / "bag", tmp_path / "new")
    assert (found.saved, found.skipped, found.lossy) == (len(sent) - 3, 3, True)


@pytest.mark.parametrize("room", [0, 2**12])
def test_a_full_disk_at_the_start_leaves_no_folder(tmp_path, room):
    """So that the same command records once there is room, instead of refusing an existing folder."""
    with files_up_to(room):
        refused = lathe("run", "piston", "--revolutions", "2", "--bag", tmp_path / "bag")
    assert (refused.exit_code in (1, 2), "(File too large)" in refused.stderr) == (True, True)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_no_half_of_a_bag(tmp_path):
    strange_bag(tmp_path / "bag", count=20_000)
    with files_up_to(2**16):
        refused = lathe("bag", "recover", tmp_path / "bag", "-o", tmp_path / "new")
    assert (refused.exit_code, refused.stderr.count("\n")) == (1, 1)
    assert "cannot write (File too large)" in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]
