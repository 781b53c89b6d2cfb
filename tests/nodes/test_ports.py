# SPDX-License-Identifier: Apache-2.0
"""Every block that comes in is checked: strangers, gaps, repeats and bad numbers are refused by name."""

import collections

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lathe_machine.stages.tool.tool import ToolParameters
from lathe_rc import messages
from lathe_rc.blocks.delay_buffer import DelayBuffer
from lathe_rc.blocks.wire import Encoder
from lathe_rc.errors import LatheError
from lathe_rc.nodes.refused_messages import RefusedMessages
from lathe_rc.protocol import BadBlock, ForeignMessage
from lathe_rc.protocol.block_queue import BlockQueue
from lathe_rc.protocol.exchange import JoinedBlocks
from lathe_rc.protocol.inputs import Inputs

SIZE = 4


def queue(**parameters) -> BlockQueue:
    table = ToolParameters(run_id="run", block_size=SIZE, **parameters)
    made = BlockQueue("/encoder", messages.ENCODER, table, ["angle"])
    made.expect("/spindle")
    return made


def block(first, *, run_id="run", source="/spindle", step_ns=15_625, angle=None, size=SIZE, last=False) -> bytes:
    signals = messages.allocate(messages.ENCODER, size)
    signals["angle"][:] = np.arange(first, first + size) if angle is None else angle
    return Encoder(messages.ENCODER, run_id, source, step_ns).encode(first, signals, last=last, companions=0)[1]


def late(data) -> bytes:
    """The same block, stamped a nanosecond later."""
    made = messages.decode(messages.ENCODER, data)
    made.header.stamp.nanosec += 1
    return messages.encode(messages.ENCODER, made)


def run_of(first, count, *, last=False) -> JoinedBlocks:
    """Blocks in one piece, the last of them shorter if the run ends with it."""
    samples = count * SIZE - (1 if last else 0)
    signals = messages.allocate(messages.ENCODER, samples)
    signals["angle"][:] = np.arange(first, first + samples)
    made = Encoder(messages.ENCODER, "run", "/spindle", 15_625)
    return JoinedBlocks(made.block(first, signals, None, last=last, companions=0), [0] * count)


def test_blocks_in_one_piece_count_one_by_one_and_are_taken_in_any_pieces():
    taken = queue()
    taken.add(block(0))
    taken.take(run_of(4, 3))
    taken.take(run_of(16, 2, last=True))
    assert (taken.received, taken.end, taken.ended) == (6, 23, True)
    pieces = [taken.pop(samples)["angle"] for samples in (8, 4, 11)]
    assert [piece.tolist() for piece in pieces] == [list(range(8)), list(range(8, 12)), list(range(12, 23))]
    assert not taken.blocks


def test_blocks_in_one_piece_that_do_not_follow_are_refused_as_single_ones_are():
    taken = queue()
    with pytest.raises(LatheError, match="goes from sample 0 to 4: 4 samples are missing"):
        taken.take(run_of(4, 3))


@given(st.lists(st.integers(1, 5), min_size=1, max_size=40), st.integers(0, 30))
def test_a_track_shows_the_same_samples_whatever_the_pieces(sizes, delay):
    track, reached = DelayBuffer(messages.ENCODER, {"angle": delay}, 10), 0
    for size in sizes:
        track.extend(size)["angle"][:] = np.arange(reached, reached + size)
        reached += size
        samples = min(10, reached)
        first = reached - samples - delay
        expected = np.maximum(np.arange(first, first + samples), 0)
        assert track.view(first, samples)["angle"].tolist() == expected.tolist()


def test_blocks_in_order_are_taken():
    taken = queue()
    for first in (0, 4, 8):
        assert taken.add(block(first)).first_index == first
    assert [b.first_index for b in taken.blocks] == [0, 4, 8]


def test_a_stage_without_inputs_follows_the_spindle_from_its_own_sample_on():
    """A late reader of the spindle may miss older blocks, which newer ones replace, but no block that it needs."""
    inputs = Inputs([], ToolParameters(run_id="run", block_size=SIZE), 2)
    pace = inputs.follow("/encoder", "/spindle", 16)
    for first in (0, 8, 12):
        assert pace.add(block(first)) is None
    assert pace.add(block(16)).first_index == 16
    assert pace.end == 20
    with pytest.raises(BadBlock, match="goes from sample 20 to 24: 4 samples are missing"):
        pace.add(block(24))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (block(4), "/spindle begins at sample 4; expected 0|goes from sample 0 to 4: 4 samples are missing"),
        (block(0, size=5), "/spindle sends 5 samples in a block; expected 4, fewer only at the end of the run"),
        (block(0, size=3), "/spindle sends 3 samples in a block; expected 4, fewer only at the end of the run"),
        (block(0, step_ns=20_000), "/spindle has a step of 20000 ns; expected 15625"),
        (late(block(0)), "/spindle stamps the block from sample 0 on with 1000046876 ns; expected 1000046875 ns"),
    ],
)
def test_a_block_that_its_source_should_not_send_is_an_error(data, words):
    with pytest.raises(LatheError, match=words) as error:
        queue().add(data)
    assert not isinstance(error.value, ForeignMessage)


def uneven(source) -> bytes:
    """A block whose arrays have different lengths."""
    made = messages.decode(messages.ENCODER, block(0, source=source))
    made.index_pulse = made.index_pulse[:1]
    return messages.encode(messages.ENCODER, made)


def test_arrays_of_different_lengths_are_an_error_of_their_source():
    with pytest.raises(LatheError, match=r"/spindle sends arrays of \[1, 4\] samples in one block") as error:
        queue().add(uneven("/spindle"))
    assert not isinstance(error.value, ForeignMessage)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (block(0, run_id="other"), "^/encoder: message of run 'other' from /spindle; expected run 'run'$"),
        (block(0, source="/ghost"), "^/encoder: message of run 'run' from /ghost; expected /spindle$"),
        (block(4, source="/ghost", size=5, step_ns=1, angle=np.nan), "from /ghost; expected /spindle"),
        (uneven("/ghost"), "from /ghost; expected /spindle"),
        (b"", r"from \?; .* cannot be decoded"),
        (bytes(3), r"from \?; .* cannot be decoded"),
        (b"\0\1\0\0" + b"\xff" * 400, r"from \?; .* cannot be decoded"),
        (block(0)[:-40], r"from \?; .* cannot be decoded"),
    ],
)
def test_a_stranger_is_refused_and_changes_nothing(data, words):
    taken = queue()
    for first in (0, 4, 8):
        with pytest.raises(ForeignMessage, match=words):
            taken.add(data)
        taken.add(block(first))
    assert [b.first_index for b in taken.blocks] == [0, 4, 8]


def test_who_was_heard_before_the_cell_is_forgotten():
    """Senders from before the run are forgotten when the cell begins."""
    taken = BlockQueue("/encoder", messages.ENCODER, ToolParameters(block_size=SIZE), ["angle"])
    taken.add(block(400, source="/ghost"))
    taken.expect("/spindle")
    taken.add(block(0))
    assert [b.source for b in taken.blocks] == ["/spindle"]


def test_too_many_foreign_messages_are_counted_together_and_told_once():
    told = []
    strangers = RefusedMessages(told.append)
    for number in [*range(1000), *range(1000)]:
        strangers.refuse(ForeignMessage("/encoder", f"/ghost_{number}" + "x" * 10_000, "run", ""))
    assert len(told) == len(strangers.senders) - 1 == 32
    assert sum(strangers.senders.values()) == 2000
    assert len(str(strangers)) < 32 * 400


@pytest.mark.parametrize(
    ("end", "last", "words"),
    [
        (12, True, "ends the run at sample 8; it ends at 12"),
        (6, True, "ends the run at sample 8"),
        (8, False, "goes on"),
    ],
)
def test_a_block_ends_the_run_where_the_cell_says(end, last, words):
    """Also one that goes beyond it: a reader of a free-running cell ran on with it."""
    taken = queue()
    taken.run_end = lambda: end
    taken.add(block(0))
    with pytest.raises(BadBlock, match=words):
        taken.add(block(4, last=last))


@pytest.mark.parametrize(("second", "words"), [(0, "a block came twice"), (8, "4 samples are missing")])
def test_a_repeat_and_a_gap_are_refused(second, words):
    taken = queue()
    taken.add(block(0))
    with pytest.raises(LatheError, match=words):
        taken.add(block(second))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_sample_that_is_not_finite_is_refused(bad):
    with pytest.raises(BadBlock, match=f"^/encoder: /spindle sends angle = {bad} at sample 2; allowed: finite"):
        queue().add(block(0, angle=[0.0, 1.0, bad, 3.0]))


def test_a_free_running_cell_counts_what_it_lost_and_holds_the_last_sample():
    taken = queue(window=0)
    taken.add(block(0))
    taken.add(block(12))
    assert taken.lost == 2
    assert [(b.first_index, b.samples) for b in taken.blocks] == [(0, 4), (4, 4), (8, 4), (12, 4)]
    assert list(taken.blocks[1].signals["angle"]) == [3.0] * 4
    with pytest.raises(LatheError, match="a block came twice"):
        taken.add(block(4))


def test_a_jump_cannot_exhaust_memory():
    taken = queue(window=0)
    taken.add(block(0))
    with pytest.raises(LatheError, match="jumps by"):
        taken.add(block(2**40))


def test_blocks_that_nobody_takes_cannot_exhaust_memory():
    taken = queue(window=1)
    firsts = range(0, SIZE * 100_000, SIZE)
    with pytest.raises(LatheError, match="blocks wait; the node cannot keep up"):
        collections.deque(taken.add(block(first)) for first in firsts)
    assert len(taken.blocks) < 1000
