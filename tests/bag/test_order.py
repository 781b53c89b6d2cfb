# SPDX-License-Identifier: Apache-2.0
"""The content of a bag does not depend on the order of arrival, and is as rosbags would have encoded and sorted it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from lathe_rc import messages
from lathe_rc.bag.writing.order import Merger
from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.blocks.wire import Decoder, Encoder
from lathe_rc.errors import LatheError
from lathe_rc.messages import START_NS

STEP_NS = 15_625
KINDS = {"/z": messages.COMMAND, "/encoder": messages.ENCODER, "/a": messages.STATE}
SOURCES = {"/z": "/one", "/encoder": "/two", "/a": "/one"}
SPARSE = {"/one/events": "/one", "/one/joint_states": "/one", "/zz": "/two"}


def encoder_of(topic):
    return Encoder(KINDS[topic], "run", SOURCES[topic], STEP_NS)


class Run:
    """Messages of a run as its nodes publish them, in the order of each node."""

    def __init__(self, rows, block, short, sparse):
        self.block, self.samples = block, rows * block - short
        self.published = {"/one": [], "/two": []}
        self.signals = {
            topic: {
                name: (np.arange(self.samples) * 7 + place).astype(dtype)
                for place, (name, dtype) in enumerate(messages.sample_fields(kind).items())
            }
            for topic, kind in KINDS.items()
        }
        self.companions = {source: [] for source in self.published}
        for first in range(0, self.samples, block):
            stop = min(first + block, self.samples)
            for source, out in self.published.items():
                for topic, index in sparse:
                    if SPARSE[topic] == source and first <= index < stop:
                        out.append((topic, START_NS + index * STEP_NS, f"{topic} {index}".encode()))
                self.companions[source].append(sum(topic in SPARSE for topic, *_ in out))
            for topic, signals in self.signals.items():
                cut = {name: array[first:stop] for name, array in signals.items()}
                source = SOURCES[topic]
                log_ns, data = encoder_of(topic).encode(
                    first, cut, last=stop == self.samples, companions=self.companions[source][-1]
                )
                self.published[source].append((topic, log_ns, data))

    def sorted(self):
        """As they must stand in the bag; sorting is stable, so equal messages keep the order of their node."""
        return sorted((m for out in self.published.values() for m in out), key=lambda m: (m[1], m[0]))

    def begin(self, path, chunk_size=4096):
        writer = BagWriter(path, compression="zstd", chunk_size=chunk_size, about={})
        qos = offered_qos(1, "volatile")
        for topic, kind in {**KINDS, **dict.fromkeys(SPARSE, messages.EVENT)}.items():
            writer.add_topic(topic, kind, qos)
        dense = {topic: (kind, SOURCES[topic]) for topic, kind in KINDS.items()}
        return writer, Merger(writer, dense, SPARSE, run_id="run", step_ns=STEP_NS, samples=self.block)


def add(merger, message, *, with_bytes):
    topic, log_ns, data = message
    if topic in SPARSE:
        merger.add_sparse(topic, log_ns, data)
    else:
        merger.add_block(topic, Decoder(KINDS[topic]).decode(data), data if with_bytes else None)
    if merger.ready:
        merger.release()


def read(path):
    with Reader(path) as reader:
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]


def read_by_two(path):
    found = read(path)
    with (path / f"{path.name}.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        by_mcap = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
        assert reader.get_summary().statistics.message_count == len(found)
    assert sorted(by_mcap) == sorted(found)
    return found


RUNS = st.builds(
    Run,
    rows=st.integers(1, 40),
    block=st.integers(2, 9),
    short=st.integers(0, 1),
    sparse=st.lists(st.tuples(st.sampled_from(sorted(SPARSE)), st.integers(0, 350)), max_size=12).map(
        lambda found: sorted(found, key=lambda each: each[1])
    ),
)


@given(run=RUNS, data=st.data())
@settings(max_examples=15, deadline=None)
def test_no_arrival_changes_the_bag(tmp_path_factory, run, data):
    """A bag is the same whoever is heard first, and whether blocks come as bytes or as arrays.

    What a node publishes on one topic is heard in its order; a later message on another topic may be heard before.
    """
    path = tmp_path_factory.mktemp("order") / "bag"
    writer, merger = run.begin(path)
    everything = [message for out in run.published.values() for message in out]
    queues = [[message for message in everything if message[0] == topic] for topic in (*KINDS, *SPARSE)]
    while any(queues):
        out = data.draw(st.sampled_from([queue for queue in queues if queue]))
        for _ in range(data.draw(st.integers(1, len(out)))):
            add(merger, out.pop(0), with_bytes=data.draw(st.booleans()) if len(out) < 20 else False)
    assert merger.complete
    assert (merger.rows, merger.samples) == (-(-run.samples // run.block), run.samples)
    writer.close()
    assert read_by_two(path) == run.sorted()


@given(run=RUNS, chunk=st.integers(1, 30))
@settings(max_examples=15, deadline=None)
def test_many_blocks_at_once_are_the_same_bag(tmp_path_factory, run, chunk):
    path = tmp_path_factory.mktemp("order") / "bag"
    writer, merger = run.begin(path)
    for first in range(0, run.samples, chunk * run.block):
        stop = min(first + chunk * run.block, run.samples)
        for out in run.published.values():
            for topic, log_ns, data in out:
                if topic in SPARSE and first <= (log_ns - START_NS) // STEP_NS < stop:
                    merger.add_sparse(topic, log_ns, data)
        for topic, signals in run.signals.items():
            companions = run.companions[SOURCES[topic]][first // run.block : -(-stop // run.block)]
            part = {name: array[first:stop] for name, array in signals.items()}
            merger.add_blocks(topic, first, part, np.array(companions), last=stop == run.samples)
        merger.release()
    assert merger.complete
    writer.close()
    assert read(path) == run.sorted()


@given(run=RUNS, share=st.floats(0, 1))
@settings(max_examples=20, deadline=None)
def test_an_interrupted_run_keeps_what_came(tmp_path_factory, run, share):
    path = tmp_path_factory.mktemp("order") / "bag"
    writer, merger = run.begin(path)
    came = [message for out in run.published.values() for message in out[: int(share * len(out))]]
    for message in came:
        add(merger, message, with_bytes=False)
    merger.write_rest()
    writer.close()
    assert read(path) == sorted(came, key=lambda m: (m[1], m[0]))


def merger_of(tmp_path, samples=8):
    writer, merger = Run(2, samples, 0, []).begin(Path(tmp_path) / "bag")
    return writer, merger


def block(topic, first, samples, *, run_id="run", last=False):
    fields = messages.sample_fields(KINDS[topic])
    signals = {name: np.zeros(samples, dtype) for name, dtype in fields.items()}
    return Encoder(KINDS[topic], run_id, SOURCES[topic], STEP_NS).block(first, signals, None, last=last, companions=0)


@pytest.mark.parametrize(
    ("blocks", "why"),
    [
        ([block("/a", 0, 7)], "/a brings 7 samples from 0; expected 8 from 0"),
        ([block("/a", 8, 8)], "/a brings 8 samples from 8; expected 8 from 0"),
        ([block("/a", 0, 8, run_id="other")], "block of run 'other' from /one; expected 'run'"),
        ([block("/a", 0, 8, last=True), block("/a", 8, 8)], "/a brings 8 samples from 8"),
        ([block("/a", 0, 8, last=True), block("/z", 0, 8), block("/z", 8, 8)], "/z brings 8 samples from 8"),
        ([block("/z", 0, 8), block("/z", 8, 8), block("/a", 0, 8, last=True)], "/a ends with block 0, others "),
        ([block("/a", 0, 5, last=True), block("/z", 0, 6, last=True)], "/z brings 6 samples from 0"),
        ([block("/a", 0, 8, last=True), block("/z", 0, 8), block("/encoder", 0, 8)], "not all end with the same one"),
    ],
)
def test_blocks_that_do_not_fit_together_are_refused(tmp_path, blocks, why):
    topics = {"/one": {1: "/z", 4: "/a"}, "/two": {5: "/encoder"}}
    writer, merger = merger_of(tmp_path)

    def bring():
        for each in blocks:
            merger.add_block(topics[each.source][len(each.signals)], each)
            if merger.ready:
                merger.release()

    with pytest.raises(LatheError, match=why):
        bring()
    writer.close()


def test_memory_does_not_grow_with_the_run(tmp_path):
    writer, merger = merger_of(tmp_path)
    for row in range(500):
        for topic in KINDS:
            merger.add_block(topic, block(topic, 8 * row, 8))
            if merger.ready:
                merger.release()
        assert len(merger._buffers) + len(merger._free) <= 2
    writer.close()
