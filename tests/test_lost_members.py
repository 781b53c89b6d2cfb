# SPDX-License-Identifier: Apache-2.0
"""Readers of a bag state no figure that rests on held samples of lost members."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from cells import scenario

from lathe_rc import harness, messages, read_bag
from lathe_rc.bag.loss import HELD, SOUND, loss_of
from lathe_rc.bag.reading.source import Source
from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.cell import part
from lathe_rc.cell.wire import Decoder, Encoder
from lathe_rc.errors import InputError
from lathe_rc.view.panel_player import Player

PLANTED = 73.1313e-6  #: every held sample, and all that may rest on it [SI units]
SEEN = re.compile(r"73\.13|7\.313|0\.07313")
TURN = 3840  #: samples of a revolution
HELD_FROM, SOUND_TO = 5 * TURN + 300, 5 * TURN - 200
#: of every kind of member but the time master, without which no sample follows
LOST = ("/coarse/command", "/coarse/state", "/tool", "/gauge/reading", "/safety", "/cross/command", "/cross/state")


def with_loss(source: Path, target: Path, about: dict[str, str], sound: int) -> Path:
    """Copy a bag; from sample ``sound`` on plant a value in all numbers but those of the encoder."""
    with Source(source) as bag:
        writer = BagWriter(target, compression="zstd", chunk_size=2**20, about={**bag.about, **about})
        for topic, said in bag.topics.items():
            writer.add_topic(topic, said.type, offered_qos(10, "transient_local"))
        for topic, log_ns, data in bag.messages():
            writer.write(topic, log_ns, planted(bag.topics[topic].type, data, sound))
        writer.close()
    return target


def planted(kind: str, data: bytes, sound: int) -> bytes:
    if kind not in messages.block_types() or kind == messages.ENCODER:
        return data
    block = Decoder(kind).decode(data)
    late = np.arange(block.first_index, block.first_index + block.samples) >= sound
    signals = {
        name: np.where(late, PLANTED, array) if array.dtype.kind == "f" else array
        for name, array in block.signals.items()
    }
    encoder = Encoder(kind, block.run_id, block.source, block.step_ns)
    return encoder.encode(block.first_index, signals, last=block.last, companions=block.companions)[1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Bag of a run in which no member was lost."""
    path = tmp_path_factory.mktemp("lost") / "whole"
    harness.run(scenario(spindle_encoder={"revolutions": 8.0}, tool={"tolerance": 2e-4}), bag=path)
    return path


@pytest.fixture(scope="module")
def lost(whole):
    about = {HELD: json.dumps({"/tool": HELD_FROM}), SOUND: str(SOUND_TO)}
    return with_loss(whole, whole.with_name("lost"), about, SOUND_TO)


WHY = f"not read from sample {SOUND_TO} on: /tool is held from sample {HELD_FROM} on, its node was lost"


def files(folder: Path) -> str:
    return "".join(path.read_text("utf-8") for path in folder.rglob("*") if path.suffix in (".html", ".csv", ".yaml"))


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("measure", "{bag}"), 3),
        (("measure", "{bag}", "--json"), 3),
        (("measure", "{bag}", "--revolutions", "6"), 2),
        (("bag", "info", "{bag}"), 3),
        (("bag", "info", "{bag}", "--json"), 3),
        (("bag", "check", "{bag}"), 3),
        (("bag", "tachogram", "{bag}", "-o", "{out}/t.csv"), 3),
        (("report", "{bag}", "-o", "{out}/r.html"), 3),
        (("compare", "{bag}", "{whole}", "-o", "{out}/c.html"), 3),
        (("export", "{bag}", "--csv", "-o", "{out}/csv"), 3),
        (("resim", "{bag}"), 2),
        (("resim", "{bag}", "--json", "--set", "learning_controller.gain=0.5"), 2),
        (("fit", "drive", "{bag}", "-o", "{out}/d.yaml", "--figure", "{out}/d.png"), None),
        (("correct", "{bag}", "--scenario", "piston", "-o", "{out}/f.csv"), 2),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_no_command_states_a_figure_that_rests_on_held_samples(words, code, lost, whole, tmp_path):
    """Held samples appear in no output and in no file; each command names the loss, and none ends with exit code 0."""
    done = lathe(*(word.format(bag=lost, whole=whole, out=tmp_path) for word in words))
    assert not SEEN.search(done.output + files(tmp_path))
    assert code is None or done.exit_code == code, done.output
    if code == 3:
        assert f"from sample {HELD_FROM} on" in done.output
    assert SEEN.search(lathe("measure", lost.with_name("unsaid")).output) is None


def test_the_planted_value_is_found_where_a_bag_does_not_name_the_loss(whole, tmp_path):
    """The search of these tests finds held samples: without the entries they are measured as any others."""
    unsaid = with_loss(whole, tmp_path / "unsaid", {}, SOUND_TO)
    assert SEEN.search(lathe("measure", unsaid).output)


@pytest.mark.parametrize("topic", LOST)
def test_the_recording_ends_before_the_first_sample_that_may_rest_on_held_ones(topic, whole, tmp_path):
    """Ten losses of a member each: earlier samples have all bits of the run, later ones are not read."""
    complete = read_bag(whole)
    with Source(whole) as bag:
        about = dict(bag.about)
    for first in np.random.default_rng(1).integers(0, complete.samples, 10).tolist():
        entries = {HELD: json.dumps({topic: first}), SOUND: str(max(first - 4096, 0))}
        sound = loss_of({**about, **entries}).first
        assert sound == max(first - 4096, 0)
        assert loss_of({HELD: entries[HELD]}).first == first, "a bag of an earlier version"
