# SPDX-License-Identifier: Apache-2.0
"""Campaign of kills: each kind of member dies at random instants, and no reader states a figure on held samples."""

import json
import os
import signal

import numpy as np
import pytest
from bags import lathe, sized, some
from cells import all_but

from lathe_rc import harness, load, read_bag
from lathe_rc.errors import LatheError

pytestmark = pytest.mark.system
REVOLUTIONS = {"supervised_full_cell": 8.0, "gauged": 8.0}
ENDLESS = 1000.0
KILLED = {
    "supervised_full_cell": [*load("supervised_full_cell").nodes],
    "gauged": ["controller", "profile", "loaded_drive", "gauge"],
}


class Killer:
    """Kills a node at the first progress from a sample on."""

    def __init__(self, node: str, sample: int) -> None:
        self.node, self.sample, self.pid = node, sample, 0

    def __call__(self, event: harness.Event) -> None:
        if event["event"] == "active" and event["node"] == self.node:
            self.pid = event["pid"]
        if event["event"] == "progress" and event["samples"] >= self.sample and self.pid:
            os.kill(self.pid, signal.SIGKILL)
            self.pid = 0


@pytest.fixture(scope="module")
def undisturbed():
    """Recordings of the same cells without kills."""
    return {
        name: harness.run(load(name, [f"spindle_encoder.revolutions={revolutions}"])).recording
        for name, revolutions in REVOLUTIONS.items()
    }


@pytest.mark.parametrize(("name", "node"), some([(name, node) for name, nodes in KILLED.items() for node in nodes], 4))
def test_a_campaign_of_kills_leaves_no_figure_on_held_samples(name, node, undisturbed, tmp_path):
    """A member of each kind is killed at ten instants: all that is read has the bits of an undisturbed run."""
    whole = undisturbed[name]
    instants = np.random.default_rng(len(node)).integers(2000, whole.samples - 8000, 10)
    for number, instant in enumerate(instants[: sized(10)].tolist()):
        bag = tmp_path / f"bag{number}"
        cell = load(name, [f"spindle_encoder.revolutions={ENDLESS}", "spindle_encoder.safe_time=0.05"])
        with pytest.raises(LatheError, match="was killed by SIGKILL"):
            harness.run(
                cell, mode="processes", groups=all_but(cell, node, "recorder"), bag=bag, watch=Killer(node, instant)
            )
        recording = read_bag(bag)
        count = min(recording.samples, whole.samples)
        for topic, signals in recording.dense.items():
            for field, samples in signals.items():
                assert np.array_equal(samples[:count], whole.dense[topic][field][:count]), f"{topic}.{field}"
        held = bool(recording.lost)
        assert held == (node not in (cell.masters[0], "recorder"))
        measured = lathe("measure", bag, "--json", "--revolutions", "1")
        if recording.revolutions:
            (first,) = json.loads(measured.stdout)["revolutions"]
            assert first["rms"] == pytest.approx(whole.errors.rms[0] * 1e6, rel=1e-12)
            assert measured.exit_code == (3 if held else 0)
        else:
            assert measured.exit_code == 2
        assert lathe("bag", "info", bag).exit_code == (3 if held else 0)
