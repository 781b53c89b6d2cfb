# SPDX-License-Identifier: Apache-2.0
"""The timeline of the panel: of a bag, of an own run, of a cell of nodes; and the map, which loses no extreme."""

import copy

import numpy as np
import pytest
from test_panel import Panel, attached, bag, hear, opened, retracted, scenario

import lathe_rc
from lathe_live import bag_pieces, panel, panel_player, panel_timeline
from lathe_live.panel_player import Player
from lathe_live.panel_run import Driver
from lathe_live.panel_topics import Topics
from lathe_live.panel_view import MOST_ROWS, View
from lathe_live.rerun_revolutions import ANGLES, DrawnRevolution
from lathe_rc import event_log, messages
from lathe_rc.errors import InputError, LatheError
from lathe_rc.safety.state_machine import State

__all__ = ["bag", "opened", "retracted"]  # fixtures
KINDS = ("fault", "alarm", "state", "command", "parameter", "lost")


def spiked(sample, value):
    """Pieces of a bag in which one sample of the form error is another."""

    def changed(*args):
        for piece in bag_pieces.pieces(*args):
            if piece.first <= sample < piece.end:
                piece.dense["/tool"]["error"][sample - piece.first] = value
            yield piece

    return changed


def test_the_timeline_of_a_bag_has_the_extremes_of_all_its_samples_and_its_events(bag):
    """Before it is played, and unchanged after it was played twice."""
    player, recording = Player(bag), lathe_rc.read_bag(bag)
    turn = np.floor(recording.of_type(messages.ENCODER)["angle_true"] / (2.0 * np.pi))
    told = player.view.timeline.shown(None, None, 512)
    error, out = (
        recording.dense["/tool"]["error"] * 1e6,
        recording.of_type(messages.SAFETY)["state"] >= State.RETRACTING,
    )
    followed = recording.dense["/coarse/command"]["position"] - recording.dense["/coarse/state"]["position"]
    for lane, signal in (
        ("error", np.where(out, np.nan, error)),
        ("out", np.where(out, error, np.nan)),
        ("following coarse", followed * 1e6),
        ("speed", recording.of_type(messages.ENCODER)["speed"] * 60.0 / (2.0 * np.pi)),
        ("state", recording.of_type(messages.SAFETY)["state"]),
        ("sample", np.arange(turn.size)),
    ):
        extremes = [[float(f(signal[turn == n])) for n in np.unique(turn)] for f in (np.fmin.reduce, np.fmax.reduce)]
        bands = np.array(told["bands"][lane], dtype=float)
        assert np.allclose(bands, extremes, rtol=1e-6, atol=0.0, equal_nan=True), lane
    assert (told["first"], told["every"], round(told["whole"][1])) == (0, 1, 8)
    kinds = {kind: [mark for mark in told["marks"] if mark["kind"] == kind] for kind in KINDS}
    (fault,), alarm = kinds["fault"], kinds["alarm"][0]
    assert fault["text"] == "spindle_encoder/events: fault encoder missed_index"
    assert fault["turn"] == pytest.approx(5.0, abs=1e-3)
    assert 5.0 < alarm["turn"] < 6.1
    assert all(mark["turn"] >= 5.0 for mark in told["marks"] if mark["kind"] in ("alarm", "state"))
    assert alarm["text"].startswith("safety/status: index_pulses encoder")
    for sample in (player.samples, 0, player.samples):
        player.seek(sample)
    assert player.view.timeline.shown(None, None, 512) == told


def test_a_spike_of_one_sample_is_in_a_band_at_every_zoom_and_is_found_by_a_click(bag, monkeypatch):
    monkeypatch.setattr(panel_player, "pieces", spiked(13_579, 250e-6))
    player = Player(bag)
    turn = int(lathe_rc.read_bag(bag).of_type(messages.ENCODER)["angle_true"][13_579] / (2.0 * np.pi))
    with Driver(player, 0.0) as driver:
        shown = Panel(driver, None, panel.player_site(driver, player))
        for cells in (1, 2, 3, 8, 100):
            told = shown.ask("timeline", cells=cells)
            assert told["bands"]["error"][1][turn // told["every"]] == 250.0
        found = shown.ask("extreme", first=1, last=4, lane="error")
        assert (found["first"], found["values"]["error"][1]) == (turn, 250.0)
        shown.ask("seek", sample=found["values"]["sample"][1] + 2)  # as the page does
        shown.until(lambda now: now["sample"] > 13_579)
        assert shown.rows[-1]["revolution"] == turn + 1
        for name, question, message in (
            ("timeline", {"cells": 0}, "cells = 0; allowed: from 1 to 4096"),
            ("timeline", {"cells": 10, "first": float("nan")}, "first = NaN; allowed: a number"),
            ("extreme", {"first": 100, "last": 200, "lane": "error"}, "allowed: received ones"),
            ("extreme", {"first": 0, "last": 1, "lane": "colour"}, "allowed: sample, state, error"),
        ):
            with pytest.raises(InputError, match=message):
                shown.ask(name, **question)


def test_a_jump_in_a_bag_reads_a_piece_of_it_and_shows_what_playing_it_shows(bag, monkeypatch):
    """Forwards and backwards, around the retraction; whatever the length of the bag, there are few checkpoints."""
    whole, played = Player(bag), {}
    jumps = [20_000, 5_000, 25_123, whole.samples, 12_345, 0, 29_999]
    for sample in sorted(jumps):
        whole.advance(sample)
        played[sample] = copy.deepcopy(whole.view.state()), whole.view.lamp.now(supervised=True)
    monkeypatch.setattr(bag_pieces, "_PIECE", 512)
    for name, value in (("_EVERY", 512), ("_MOST", 16)):
        monkeypatch.setattr(panel_player, name, value)
    player, read = Player(bag), []
    told = [each.sample for each in player._checkpoints]
    assert 8 <= len(told) <= 16
    shown = player._show
    monkeypatch.setattr(player, "_show", lambda piece: (read.append(piece.samples), shown(piece)))
    for sample in jumps:
        read.clear()
        player.seek(sample)
        assert sum(read) <= max(np.diff([*told, player.samples]))
        state, lamp = played[sample]
        found = player.view.state()
        assert player.view.lamp.now(supervised=True) == lamp
        for name in ("_now", "_log", "_end", "_complete", "_out"):
            assert found[name] == state[name], (sample, name)
        assert [row.told() for row in found["_newest"]] == [row.told() for row in state["_newest"]]
        assert (found["_part"] is None) == (state["_part"] is None)
        if state["_part"]:
            assert np.array_equal(found["_part"].largest, state["_part"].largest)
    player.seek(0)
    bag.rename(bag.with_name("gone"))
    try:
        with pytest.raises(LatheError, match="broken"):
            player.seek(20_000)
    finally:
        bag.with_name("gone").rename(bag)


def test_commands_and_parameters_of_an_own_run_are_marked_at_their_sample(opened):
    """The bands go on after another parameter; a restart begins a new timeline."""
    shown = opened(scenario("piston", 12))
    for _ in range(3):
        shown.step()
    shown.ask("act", node="learning_controller", action="freeze")
    at = shown.now["sample"]
    shown.ask("change", values={"learning_controller.lead_time": "1.3e-3"}, here=True)
    shown.step()
    told = shown.ask("timeline", cells=100)
    marks = {mark["kind"]: mark for mark in told["marks"] if mark["sample"] == at}
    assert marks["command"]["text"] == "learning_controller/events: freeze"
    assert marks["parameter"]["text"] == "goes on with learning_controller.lead_time = 0.0013"
    assert [marks[kind]["turn"] for kind in ("command", "parameter")] == pytest.approx([3.0, 3.0], abs=0.02)  # a block
    assert len(told["bands"]["error"][0]) == shown.now["angle"] // (2.0 * np.pi) + 1
    shown.ask("change", values={}, here=False)
    told = shown.ask("timeline", cells=100)
    assert (told["marks"], told["bands"]["error"], told["whole"]) == ([], [[], []], [0.0, 0.0])


def test_samples_that_an_attached_panel_has_not_received_are_a_gap_with_a_mark(retracted):
    """The bands before and after it are those of the cell, and one line counts what was left out."""
    types, heard = retracted
    live, whole = attached(types), attached(types)
    hear(whole, heard)
    third = len(heard) // 3
    hear(live, [*heard[:third], *(each for each in heard[third:-third] if each[1] not in messages.block_types())])
    hear(live, heard[-third:])
    full, told = (each.view.timeline.shown(None, None, 100) for each in (whole, live))
    there = [low is not None for low in told["bands"]["speed"][0]]
    assert there == [True, True, True, False, False, True, True, True]
    for lane in ("error", "out", "following coarse", "speed"):
        assert [side[:2] + side[-2:] for side in told["bands"][lane]] == [s[:2] + s[-2:] for s in full["bands"][lane]]
    assert {mark["kind"] for mark in told["marks"]} >= {"lost", "fault", "alarm"}
    live.know()
    assert live.view.latest.now["left_out"].startswith("left out, wholly or in part")
    assert not any("left out" in line["text"] for line in live.view.latest.log)


def test_a_topic_that_is_heard_late_has_a_gap_before_it(retracted):
    types, heard = retracted
    live = attached({topic: kind for topic, kind in types.items() if topic != "/tool"})
    hear(live, [each for k, each in enumerate(heard) if each[0] != "/tool" or k > len(heard) // 2])
    told = live.view.timeline.shown(None, None, 100)["bands"]
    assert (told["error"][0][0], told["speed"][0][0] is None) == (None, False)
    assert told["error"][0][5] is not None
    assert told["out"][0][-1] is not None


def test_latched_messages_from_before_the_first_sample_are_marked_as_such(retracted):
    types, heard = retracted
    live = attached(types)
    late = [message for message in heard[-len(heard) // 5 :] if message[1] not in event_log.LOGGED]
    hear(live, [*(message for message in heard if message[1] in event_log.LOGGED), *late])
    told = live.view.timeline.shown(None, None, 100)
    (fault,) = (mark for mark in told["marks"] if mark["kind"] == "fault")
    assert fault["text"] == "before the samples received: spindle_encoder/events: fault encoder missed_index"
    assert fault["turn"] == told["whole"][0] > 5.0
    assert told["bands"]["state"][0][0] == State.SAFE  # as the messages say


def test_marks_take_bounded_memory_and_count_what_they_stand_for(monkeypatch):
    monkeypatch.setattr(panel_timeline, "MOST_MARKS", 16)
    timeline = panel_timeline.Timeline(Topics.of({"/encoder": messages.ENCODER}))
    turns = np.linspace(0.0, 1e4, 10**5)
    timeline.chunk(0, turns.size, {"/encoder": {"angle_true": 2.0 * np.pi * turns, "speed": turns}}, {}, 0)
    for k in range(1000):
        timeline.mark(100 * k, "limit" if k % 2 else "lost", "text")
    assert len(timeline._marks) <= 16
    marks = timeline.shown(None, None, 100)["marks"]
    for kind in ("limit", "lost"):
        assert sum(mark["count"] for mark in marks if mark["kind"] == kind) == 500


def test_the_map_of_a_long_run_shows_the_largest_error_of_all_its_revolutions():
    """One revolution of 1099 is beyond the others; those in which the tool was out of the part do not count."""
    view, errors = View({}, 15_625), np.random.default_rng(3).standard_normal((1099, ANGLES)) * 1e-7
    errors[345, 120] = 50e-6
    for number, error in enumerate(errors, start=1):
        view._out = (1094, np.inf) if number == 1094 else view._out
        view._add([DrawnRevolution(number, number, error, -error, 0.0, 1e-7, 1e-7)])
    rows = [*view._rows, view._open]
    assert MOST_ROWS // 2 < len(rows) <= MOST_ROWS
    assert [row.since for row in rows[1:]] == [row.number + 1 for row in rows[:-1]]
    (found,) = (row for row in rows if row.since <= 346 <= row.number)
    assert found.cells[60] == -50.0
    largest = np.abs(errors[:1096]).reshape(-1, 8, 180, 2)
    largest[-1, -2:] = 0.0
    assert np.allclose([np.abs(row.cells) for row in rows[:-1]], largest.max(axis=(1, 3)) * 1e6, rtol=1e-3)
    assert [row.out for row in rows[-2:]] == [False, True]
