# SPDX-License-Identifier: Apache-2.0
"""The quick codec of blocks: its bytes are those of rosbags, and what it cannot read it says."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lathe_rc.cell import messages
from lathe_rc.cell.wire import Decoder, Encoder

types = st.sampled_from(sorted(messages.block_types()))
lengths = st.one_of(st.integers(1, 70), st.just(messages.MAX_BLOCK))
names = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=60)
steps = st.sampled_from([1000, 15_625, 1_000_000])


def signals_of(msgtype, samples, seed):
    """Random bits as samples, NaN among them."""
    bits = np.random.default_rng(seed)
    return {
        name: np.frombuffer(bits.bytes(samples * dtype.itemsize), dtype)
        for name, dtype in messages.sample_fields(msgtype).items()
    }


def by_rosbags(msgtype, signals, *, info, frame="", stamp=(1, 0)):
    """Bytes of a block, made by rosbags from its Python class."""
    known = messages.store().types
    head = known["std_msgs/msg/Header"](known["builtin_interfaces/msg/Time"](*stamp), frame)
    block = known[f"{messages.PACKAGE}/msg/BlockInfo"](*info)
    return messages.encode(msgtype, known[msgtype](head, block, *signals.values()))


def same_bits(a, b):
    return a.keys() == b.keys() and all(a[name].tobytes() == b[name].tobytes() for name in a)


@given(
    types, st.lists(lengths, min_size=1, max_size=3), names, names, steps, st.integers(0, 2**40), st.booleans(),
    st.integers(0, 2**64 - 1),
)  # fmt: skip
def test_bytes_are_those_of_rosbags_and_come_back(msgtype, sizes, run_id, source, step_ns, first, last, companions):
    encoder, decoder = Encoder(msgtype, run_id, source, step_ns), Decoder(msgtype)
    for seed, samples in enumerate(sizes):
        signals = signals_of(msgtype, samples, seed)
        log_ns, data = encoder.encode(first, signals, last=last, companions=companions)
        assert log_ns == 1_000_000_000 + (first + samples - 1) * step_ns
        info = (run_id, source, first, step_ns, last, companions)
        assert data == by_rosbags(msgtype, signals, info=info, stamp=divmod(log_ns, 1_000_000_000))
        block = decoder.decode(data)
        assert (block.run_id, block.source, block.first_index, block.step_ns, block.last, block.companions) == info
        assert (block.samples, block.log_ns) == (samples, log_ns)
        assert same_bits(block.signals, signals)


def encoded(source="/tool", samples=5, msgtype=messages.TOOL):
    signals = signals_of(msgtype, samples, 1)
    return signals, Encoder(msgtype, "run", source, 15_625).encode(0, signals, last=False, companions=0)[1]


def test_decoder_follows_another_source_and_length():
    decoder = Decoder(messages.TOOL)
    for source, samples in (("/tool", 5), ("/tool", 5), ("/edge", 5), ("/tool", 6), ("/tool", 5)):
        signals, data = encoded(source, samples)
        block = decoder.decode(data)
        assert (block.source, block.samples) == (source, samples)
        assert same_bits(block.signals, signals)


def test_decoder_reads_the_fields_it_was_asked_for():
    assert set(Decoder(messages.TOOL, ["error", "height"]).decode(encoded()[1]).signals) == {"error", "height"}


def test_earlier_block_is_not_changed_by_a_later_one():
    encoder = Encoder(messages.COMMAND, "run", "/a", 15_625)
    first = encoder.encode(0, {"position": np.ones(3)}, last=False, companions=0)[1]
    encoder.encode(3, {"position": np.zeros(3)}, last=True, companions=0)
    assert list(Decoder(messages.COMMAND).decode(first).signals["position"]) == [1.0, 1.0, 1.0]


INFO = ("run", "/tool", 0, 15_625, False, 0)


def test_block_with_a_frame_is_refused():
    signals, _ = encoded()
    with pytest.raises(ValueError, match=r"^/tool sends a block that is not encoded as .* with no frame_id$"):
        Decoder(messages.TOOL).decode(by_rosbags(messages.TOOL, signals, info=INFO, frame="lathe"))


def test_block_of_arrays_of_different_lengths_is_refused():
    signals, _ = encoded()
    signals["error"] = signals["error"][:-1]
    with pytest.raises(ValueError, match=r"/tool sends arrays of \[4, 5\] samples in one block"):
        Decoder(messages.TOOL).decode(by_rosbags(messages.TOOL, signals, info=INFO))


def test_block_without_samples_is_refused():
    with pytest.raises(ValueError, match=r"/tool sends arrays of \[0\] samples in one block"):
        Decoder(messages.TOOL).decode(by_rosbags(messages.TOOL, signals_of(messages.TOOL, 0, 0), info=INFO))


@given(st.integers(0, 4), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_number_that_is_not_finite_is_refused_with_its_field(place, number):
    signals = {name: np.full(5, 1e308) for name in messages.sample_fields(messages.TOOL)}
    encoder, target = Encoder(messages.TOOL, "run", "/tool", 15_625), {"error": np.empty(5)}
    signals["height"][place] = number  # not asked for
    data = encoder.encode(640, signals, last=False, companions=0)[1]
    Decoder(messages.TOOL).decode(data).copy_to(target)
    assert np.all(target["error"] == 1e308)
    signals["error"][place] = number
    data = encoder.encode(640, signals, last=False, companions=0)[1]
    with pytest.raises(ValueError, match=rf"^/tool sends error = {number} at sample {640 + place}; "):
        Decoder(messages.TOOL).decode(data).copy_to(target)


def test_fields_and_bounds_are_those_of_the_message_files():
    for msgtype in messages.block_types():
        fields = messages.sample_fields(msgtype)
        assert fields
        assert {dtype.str for dtype in fields.values()} <= {"<f8", "|u1"}
        lines = messages.store().generate_msgdef(msgtype)[0].split("====")[0]
        for name in fields:
            assert f"[<={messages.MAX_BLOCK}] {name}" in lines


@given(data=st.data(), block=st.integers(1, 9))
def test_many_blocks_read_at_once_are_those_read_one_by_one(data, block):
    """Lengths, sources, gaps and ends may change anywhere; what follows one another comes as one block."""
    decoder, encoded = Decoder(messages.ENCODER), []
    first = data.draw(st.integers(0, 2**40))
    for _ in range(data.draw(st.integers(1, 20))):
        samples = data.draw(st.sampled_from([block, block, block, block + 1]))
        source = data.draw(st.sampled_from(["/a", "/a", "/a", "/b"]))
        first += data.draw(st.sampled_from([0, 0, 0, 0, 3]))
        signals = signals_of(messages.ENCODER, samples, first % 1000)
        encoder = Encoder(messages.ENCODER, "run", source, 15_625)
        last = data.draw(st.booleans())
        encoded.append(encoder.encode(first, signals, last=last, companions=first % 7)[1])
        first += samples
    singles = [decoder.decode(message) for message in encoded]
    edges = np.cumsum([0, *map(len, encoded)])
    places = np.stack([edges[:-1], edges[1:]], axis=1)
    joined = list(Decoder(messages.ENCODER).decode_all(b"".join(encoded), places))
    assert sum(each.samples for each in joined) == sum(each.samples for each in singles)
    for name in singles[0].signals:
        whole = np.concatenate([each.signals[name] for each in joined])
        assert whole.tobytes() == b"".join(each.signals[name].tobytes() for each in singles)
    ends = {each.first_index + each.samples: each for each in singles}
    for each in joined:
        end = ends[each.first_index + each.samples]
        assert (each.source, each.last, each.log_ns) == (end.source, end.last, end.log_ns)
        assert each.companions == end.companions
    starts = {each.first_index for each in joined}
    for before, after in pairwise(singles):
        if before.first_index + before.samples != after.first_index or before.source != after.source:
            assert after.first_index in starts
