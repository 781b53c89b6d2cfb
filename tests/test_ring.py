"""The offline host's memory of a topic: what it hands out is the past, whatever the delays and the chunk."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lathe_rc.cell import messages
from lathe_rc.cell.ring import Ring


@given(
    chunk=st.integers(1, 20),
    chunks=st.integers(1, 12),
    last=st.integers(0, 19),
    delays=st.lists(st.integers(1, 70), min_size=1, max_size=3),
    lanes=st.sampled_from([0, 2]),
)
def test_what_is_read_late_is_what_was_written(chunk, chunks, last, delays, lanes):
    longest = max(delays)
    ring = Ring(messages.ENCODER, {"angle": longest, "speed": 0}, chunk, lanes)
    samples = chunk * chunks + min(last, chunk - 1)
    whole = np.concatenate([np.zeros(longest), np.arange(1.0, samples + 1)])  # from sample -longest on
    shape = (-1, lanes) if lanes else (-1,)
    for first in range(0, samples, chunk):
        size = min(chunk, samples - first)
        wanted = whole[longest + first :][:size]
        for name, array in ring.newest(first, size).items():
            array[:] = np.broadcast_to(wanted[:, None], (size, lanes)) if lanes else wanted
            assert array.size == size * (lanes or 1), name
        for delay in delays:
            seen = ring.view(first, size, delay)
            assert list(seen) == ["angle"], "speed is not kept"
            expected = whole[longest + first - delay :][:size]
            assert np.array_equal(seen["angle"].reshape(shape)[..., 0] if lanes else seen["angle"], expected)


def test_whole_chunks_are_views_of_memory_that_comes_again():
    ring = Ring(messages.ENCODER, {"angle": 20, "speed": 0}, 10)
    assert ring.period == 3
    now, late = ring.newest(30, 10)["angle"], ring.view(50, 10, 20)["angle"]
    assert np.shares_memory(now, late)
    assert np.shares_memory(now, ring.newest(60, 10)["angle"]), "a period later"
    assert not np.shares_memory(now, ring.newest(40, 10)["angle"])
    assert np.shares_memory(ring.newest(30, 10)["speed"], ring.newest(40, 10)["speed"]), "one chunk is enough"


@pytest.mark.parametrize("delay", [4, 15])
def test_what_is_not_whole_chunks_is_put_together(delay):
    ring = Ring(messages.ENCODER, {"angle": delay}, 10)
    for first in range(0, 60, 10):
        ring.newest(first, 10)["angle"][:] = np.arange(first, first + 10)
        assert np.array_equal(ring.view(first, 10, delay)["angle"], np.maximum(np.arange(first, first + 10) - delay, 0))
