# SPDX-License-Identifier: Apache-2.0
"""Two thousand damages to bags, and what is recovered; tests/bag/test_recover.py has a sample."""

from collections import Counter
from random import Random

import pytest
from bags import sized
from cells import scenario
from mcap.opcode import Opcode
from mcap_damage import check_damage, chunks_of, flipped, flips, plain_file, records_of, saved_of, small_bag, structured

from lathe_rc import harness
from lathe_rc.bag.repairing.recover import recover

pytestmark = pytest.mark.system


@pytest.mark.parametrize("compression", ["zstd", "none"])
@pytest.mark.parametrize("kind", [flips, structured])
def test_every_damage_costs_no_more_than_the_chunks_that_it_hits(tmp_path, compression, kind):
    data = small_bag(tmp_path / "bag", compression)
    _, whole = saved_of(tmp_path / "bad.mcap", data)
    for damaged in kind(data, sized(500), Random(11)):  # noqa: S311
        check_damage(tmp_path / "bad.mcap", whole, damaged)


@pytest.mark.parametrize("complete", [True, False])
def test_several_damages_at_once(tmp_path, complete):
    """Also to a bag that was cut off: schemas and channels come from whichever chunk is whole."""
    data = small_bag(tmp_path / "bag", chunks=20)
    data = data if complete else data[: chunks_of(data)[-1][1]]
    salvage, whole = saved_of(tmp_path / "bad.mcap", data)
    random = Random(12)  # noqa: S311
    for _ in range(sized(200)):
        damaged = bytearray(data)
        for place in random.sample(range(8, len(data)), 8):
            damaged[place] ^= 1 << random.randrange(8)
        salvage, saved = saved_of(tmp_path / "bad.mcap", bytes(damaged))
        hit = sum(damaged[begin:end] != data[begin:end] for begin, end in chunks_of(data))
        assert len(saved) >= len(whole) - 40 * hit
        assert set(saved) <= set(whole)
        assert salvage.lossy or len(saved) == len(whole)


def test_bag_of_a_cell(tmp_path):
    """The new bags, too: what was saved is read, and the exit code is right."""
    made = scenario(spindle_encoder={"revolutions": 20.0}, recorder={"chunk_size": 65536})
    harness.run(made, bag=tmp_path / "bag")
    data = (tmp_path / "bag" / "bag.mcap").read_bytes()
    bad = tmp_path / "bad.mcap"
    _, whole = saved_of(bad, data)
    ends = [end for _, end in chunks_of(data)]
    counts = [len(saved_of(bad, data[:end])[1]) for end in ends]
    sizes = [later - earlier for earlier, later in zip([0, *counts], counts, strict=False)]
    damages = [*flips(data, sized(60), Random(13)), *structured(data, sized(60), Random(14))]  # noqa: S311
    for number, damaged in enumerate(damages):
        bad.write_bytes(damaged.data)
        found = recover(bad, tmp_path / f"new{number}")
        assert found.saved >= len(whole) - sum(sizes[chunk] for chunk in damaged.hit), damaged.what
        assert found.lossy or found.saved == len(whole), damaged.what
        _, again = saved_of(tmp_path / "again.mcap", (tmp_path / f"new{number}" / f"new{number}.mcap").read_bytes())
        assert len(again) == found.saved
        assert not Counter(again) - Counter(whole)


def test_messages_outside_of_chunks(tmp_path):
    """A damaged head costs at most two messages; no wrong value comes out without a word."""
    file = tmp_path / "plain.mcap"
    data = plain_file(file, 300)
    _, whole = saved_of(file, data)
    end = next(begin for opcode, begin, _ in records_of(data) if opcode == Opcode.DATA_END)
    random = Random(15)  # noqa: S311
    for _ in range(sized(500)):
        place = random.randrange(8, end)
        salvage, saved = saved_of(file, flipped(data, place, 1 << random.randrange(8)))
        assert len(saved) >= len(whole) - 2 or "described" in "".join(salvage.damage)
        assert salvage.lossy or saved == whole
