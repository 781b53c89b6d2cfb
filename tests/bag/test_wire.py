# SPDX-License-Identifier: Apache-2.0
"""The quick codec of blocks: its bytes are those of rosbags, and what it cannot read it says."""

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lathe_rc import messages
from lathe_rc.blocks.wire import Decoder, Encoder, NoBlockError

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


class Cdr:
    """CDR as the standard has it (XCDR version 1), written independently of rosbags; padding is random.

    Args:
        big: big-endian.
        noise: random numbers.
        representation: identifier in the encapsulation; None: of CDR in this byte order.
    """

    def __init__(self, big, noise, representation=None):
        self.order, self.noise = (">" if big else "<"), noise
        identifier = int(not big) if representation is None else representation
        self.head, self.body = identifier.to_bytes(2, "big") + noise.bytes(2), b""

    def align(self, size):
        self.body += self.noise.bytes(-len(self.body) % size)

    def number(self, kind, value):
        self.align(struct.calcsize(kind))
        self.body += struct.pack(self.order + kind, value)

    def text(self, value):
        content = value.encode() + b"\0"
        self.number("I", len(content))
        self.body += content

    def array(self, samples):
        self.number("I", samples.size)
        self.align(samples.itemsize)
        self.body += samples.astype(samples.dtype.newbyteorder(self.order)).tobytes()

    def bytes(self, rest):
        return self.head + self.body + self.noise.bytes(rest)


def by_hand(msgtype, signals, info, log_ns, *, seed, frame="", big=False, rest=0, representation=None):
    """A block as another implementation may encode it, with ``rest`` bytes of padding at its end."""
    made = Cdr(big, np.random.default_rng(seed), representation)
    seconds, nanoseconds = divmod(log_ns, 1_000_000_000)
    made.number("i", seconds)
    made.number("I", nanoseconds)
    made.text(frame)
    made.text(info[0])
    made.text(info[1])
    for kind, value in zip("QI?Q", info[2:], strict=True):
        made.number(kind, value)
    for array in signals.values():
        made.array(array)
    return made.bytes(rest)


@settings(max_examples=20)
@given(
    types, st.integers(1, 70), names, names, names, st.booleans(), st.integers(0, 3), st.booleans(),
    st.integers(0, 2**32),
)  # fmt: skip
def test_blocks_as_others_may_encode_them_are_taken(msgtype, samples, run_id, source, frame, big, rest, last, seed):
    """Of 1000 blocks with random padding, in any byte order, with any frame and encapsulation, none is refused."""
    decoder, ours = Decoder(msgtype), Encoder(msgtype, run_id, source, 15_625)
    for number in range(50):
        end = last and number == 49
        signals = signals_of(msgtype, (samples + 1) // 2 if end else samples, seed + number)
        info = (run_id, source, number * samples, 15_625, end, 7 * number)
        log_ns, expected = ours.encode(info[2], signals, last=end, companions=info[5])
        data = by_hand(msgtype, signals, info, log_ns, seed=seed + number, frame=frame, big=big, rest=rest)
        block = decoder.decode(data)
        assert (block.run_id, block.source, block.first_index, block.step_ns, block.last, block.companions) == info
        assert (block.log_ns, same_bits(block.signals, signals)) == (log_ns, True)
        assert decoder.message == expected


@pytest.mark.parametrize("frame", ["", "lathe"])
def test_a_block_that_ros_itself_serializes_is_taken(frame):
    serialization = pytest.importorskip("rclpy.serialization")
    from lathe_rc_msgs.msg import ToolBlock

    signals, ours = encoded()
    decoder = Decoder(messages.TOOL)
    message = ToolBlock(**{name: array.tolist() for name, array in signals.items()})
    message.header.stamp.sec, message.header.stamp.nanosec = 1, 4 * 15_625
    message.header.frame_id = frame
    message.block.run_id, message.block.source, message.block.step_ns = "run", "/tool", 15_625
    block = decoder.decode(serialization.serialize_message(message))
    assert (block.source, decoder.message) == ("/tool", ours)


@pytest.mark.parametrize("big", [False, True])
def test_bytes_that_are_no_block_are_refused_in_any_encoding(big):
    """Other encapsulations than plain CDR, missing or additional bytes, arrays of different lengths or empty."""
    signals, _ = encoded()
    data, decoder = by_hand(messages.TOOL, signals, INFO, 0, seed=1, big=big), Decoder(messages.TOOL)
    others = [by_hand(messages.TOOL, signals, INFO, 0, seed=1, representation=k) for k in (2, 3, 6, 7, 10, 0x0100)]
    for broken in (data[:-1], data[:40], data + bytes(4), b"", data[:3], *others):
        with pytest.raises(NoBlockError, match="ToolBlock cannot be decoded"):
            decoder.decode(broken)
    short = by_hand(messages.TOOL, signals | {"error": signals["error"][:-1]}, INFO, 0, seed=1, big=big)
    empty = by_rosbags(messages.TOOL, signals_of(messages.TOOL, 0, 0), info=INFO)
    for uneven, sizes in ((short, "4, 5"), (empty, "0")):
        with pytest.raises(ValueError, match=rf"^/tool sends arrays of \[{sizes}\] samples in one block$"):
            decoder.decode(uneven)


@given(st.integers(0, 4), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_number_that_is_not_finite_is_refused_with_its_field(place, number):
    signals = {name: np.full(5, 1e308) for name in messages.sample_fields(messages.TOOL)}
    encoder, decoder = Encoder(messages.TOOL, "run", "/tool", 15_625), Decoder(messages.TOOL, ["error"])
    signals["height"][place] = number  # not asked for
    data = encoder.encode(640, signals, last=False, companions=0)[1]
    decoder.decode(data).check()
    signals["error"][place] = number
    data = encoder.encode(640, signals, last=False, companions=0)[1]
    with pytest.raises(ValueError, match=rf"^/tool sends error = {number} at sample {640 + place}; "):
        decoder.decode(data).check()


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
    """Lengths, sources, encodings, gaps, ends may change anywhere; what follows one another comes as one block."""
    decoder, encoded = Decoder(messages.ENCODER), []
    first = data.draw(st.integers(0, 2**40))
    for _ in range(data.draw(st.integers(1, 20))):
        samples = data.draw(st.sampled_from([block, block, block, block + 1]))
        source = data.draw(st.sampled_from(["/a", "/a", "/a", "/b"]))
        first += data.draw(st.sampled_from([0, 0, 0, 0, 3]))
        signals = signals_of(messages.ENCODER, samples, first % 1000)
        encoder = Encoder(messages.ENCODER, "run", source, 15_625)
        last = data.draw(st.booleans())
        log_ns, ours = encoder.encode(first, signals, last=last, companions=first % 7)
        info = ("run", source, first, 15_625, last, first % 7)
        theirs = by_hand(messages.ENCODER, signals, info, log_ns, seed=first, big=data.draw(st.booleans()))
        encoded.append(data.draw(st.sampled_from([ours, ours, ours, theirs])))
        first += samples
    singles = [decoder.decode(message) for message in encoded]
    edges = np.cumsum([0, *map(len, encoded)])
    places = np.stack([edges[:-1], edges[1:]], axis=1)
    found = list(Decoder(messages.ENCODER).decode_all(b"".join(encoded), places))
    joined = [block for block, _ in found]
    assert sum(count for _, count in found) == len(encoded)
    assert not any(
        block.last
        for block in singles
        if block.first_index + block.samples not in {b.first_index + b.samples for b in joined}
    )
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
