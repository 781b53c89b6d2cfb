# SPDX-License-Identifier: Apache-2.0
"""Counts of a real encoder: reading them, the angle between them, and a cell that follows a file of them, offline."""

import io
import itertools
import json
import os
import pty

import numpy as np
import pytest
from cells import encoder, scenario
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused
from numpy.testing import assert_allclose

from lathe_bagtools.resimulation.resim import resimulate
from lathe_machine.signals.counts import CountedAngle, CsvReader, LineReader
from lathe_machine.stages.spindle.encoder_device import EncoderDevice
from lathe_rc import harness
from lathe_rc.bag.reading import stream
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cli import main
from lathe_rc.errors import LatheError
from lathe_rc.signals import speed
from lathe_rc.view.report_form import FormByRevolution

STEP_NS, COUNTS = 15_625, 1000
TURN = 2 * np.pi
LAW = speed.harmonic(104.72, np.array([0.05]), np.array([60.0]), np.array([0.0]))


def filled(times, counts, of=COUNTS, **changed):
    """The angle by readings; whole counts as integers, for a double would round them."""
    given_ = {"counts": of, "step_ns": STEP_NS, "wraps": 0, "inverted": False, "max_reverse": 2.0, "max_gap": 0.01}
    angle = CountedAngle(**{**given_, **changed})
    for time, count in zip(np.asarray(times).tolist(), np.asarray(counts, dtype=object).tolist(), strict=True):
        angle.add(time, count)
    return angle


@pytest.fixture
def path(tmp_path):
    return tmp_path / "counts.csv"


# --- readers


def read(text):
    return list(LineReader(io.BytesIO(text), "line").read())


def test_lines_are_readings_whatever_parts_them():
    text = b"time_ns,counts\n# a comment\n\n1700000000000000001,5\n1700000000000000002; 6.5\r\n+3 \t -7\n4,8"
    assert read(text) == [(1700000000000000001, 5.0), (1700000000000000002, 6.5), (3, -7.0), (4, 8.0)]


_LINES = [b"5", b"1,2,3", b"a,b", b"1.5,2", b"1,--2", b"\xff\xfe,1", b"1,nan", b"1,", b",2", b"1e999999999,2"]


@pytest.mark.parametrize("line", [*_LINES, b"%d,2" % 2**63])
def test_a_line_that_is_no_reading_is_refused_by_name(line):
    text = b"1,2\n" + line + b"\n"
    assert_refused(lambda: read(text), r"^line: '.*'; allowed: a time and a counter, as time_ns,counts$")


def test_what_has_no_lines_is_refused():
    endless = LineReader(_Ready([b"x" * 1000]), "line").read()
    assert_refused(lambda: list(endless), "1000 bytes without an end of line; allowed: lines of text")


class _Ready:
    """A stream with nothing behind what has come."""

    def __init__(self, pieces):
        self.pieces = pieces

    def read(self, size):
        return self.pieces.pop(0) if self.pieces else None


@given(st.lists(st.integers(1, 9), min_size=1, max_size=40))
def test_lines_come_in_any_pieces(cuts):
    text = b"".join(b"%d,%d\n" % (n, 2 * n) for n in range(20))
    pieces = [bytes(piece) for piece in np.split(np.frombuffer(text, "S1"), np.cumsum(cuts)) if piece.size]
    reader = LineReader(_Ready(pieces), "line")
    found = [reading for _ in pieces.copy() for reading in reader.read()]
    assert found == [(n, 2 * n) for n in range(20)]
    assert not reader.ended


def test_a_terminal_is_read_raw_and_its_first_line_may_lack_its_beginning():
    """Nothing is waited for; when the other end has gone the line has ended."""
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    assert_refused(lambda: LineReader.open(name, 12345), r"12345 baud; allowed: .*9600.*115200")
    reader = LineReader.open(name, 115200)
    os.close(theirs)
    for sent, readings in ((b"", []), (b"00,7\n1,2\n3,", [(1, 2)]), (b"4\n", [(3, 4)])):
        os.write(ours, sent)
        assert list(reader.read()) == readings
    os.close(ours)
    assert list(reader.read()) == []
    assert reader.ended
    reader.close()


def test_a_pipe_has_not_ended_before_somebody_writes_to_it(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = LineReader.open(tmp_path / "pipe", 115200)
    assert list(reader.read()) == []
    with (tmp_path / "pipe").open("wb") as writer:
        writer.write(b"1,2\n3,4")
    assert list(reader.read()) == [(1, 2.0), (3, 4.0)]
    assert reader.ended
    reader.close()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("# made by hand\ntime_ns,counts\n10,1\n\n20,2\n", [(10, 1.0), (20, 2.0)]),
        ("time_s, counts\n1700000000.000000001,1\n1.5,2\n", [(1700000000000000001, 1.0), (1_500_000_000, 2.0)]),
        (f"\ufefftime_ns,counts\n{2**62},{2**62 + 1}\n", [(2**62, 2**62 + 1)]),
    ],
)  # fmt: skip
def test_a_file_says_its_unit_of_time_and_loses_no_nanosecond(path, text, found):
    path.write_text(text)
    reader = CsvReader(path)
    assert list(reader.read()) == found
    assert reader.ended
    assert list(reader.read()) == []


def test_a_file_with_another_header_or_line_is_refused(path):
    for row in ("1,x", "0,001;5;", "1e999999999,2"):
        path.write_text(f"time_s,counts\n1,2\n{row}\n")
        assert_refused(lambda: list(CsvReader(path).read()), rf"counts.csv:3: '{row}'; allowed")
    path.write_text("time,counts\n1,2\n")
    assert_refused(lambda: CsvReader(path), "columns 'time, counts'; allowed: time_ns,counts or time_s,counts")


# --- the angle


def test_angle_is_linear_between_readings_and_begins_within_a_revolution():
    angle = filled([10**9, 10**9 + 4 * STEP_NS, 10**9 + 8 * STEP_NS], [3250, 3254, 3262])
    assert angle.available == 9
    assert_allclose(angle.take(0, 9) * COUNTS / TURN, [250, 251, 252, 253, 254, 256, 258, 260, 262])


@given(st.lists(st.integers(1, 50), min_size=1, max_size=30), st.integers(0, 2**32 - 1))
def test_pieces_change_no_bit_of_the_angle(cuts, seed):
    random = np.random.default_rng(seed)
    times, counts = np.cumsum(random.integers(1, 200_000, 60)), np.cumsum(random.integers(0, 9, 60))
    whole = filled(times, counts)
    expected = whole.take(0, whole.available)
    angle, found = filled([], []), np.empty(0)
    for time, count, cut in zip(times.tolist(), counts.tolist(), itertools.cycle(cuts), strict=False):
        angle.add(time, count)
        found = np.append(found, angle.take(found.size, min(cut, angle.available - found.size)))
    found = np.append(found, angle.take(found.size, angle.available - found.size))
    assert np.array_equal(found, expected)
    assert np.all(np.diff(expected) >= 0.0)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("wraps", [COUNTS, 2**16])
def test_a_counter_that_begins_anew_goes_on(inverted, wraps):
    times, counts = np.arange(300) * 1_000_000, 70_000 + 37 * np.arange(300)
    plain = filled(times, counts)
    sent = (-counts if inverted else counts) % wraps
    wrapped = filled(times, sent, wraps=wraps, inverted=inverted)
    size = plain.available
    difference = (wrapped.take(0, size) - plain.take(0, size)) / TURN
    assert_allclose(difference, difference[0], atol=1e-9)


@pytest.mark.parametrize("start", [2**62, 2**63 - 300, -(2**62), 2**53 - 5])
@pytest.mark.parametrize("changed", [{}, {"inverted": True}, {"wraps": 2**16}, {"wraps": 3001}])
def test_counts_far_from_0_keep_their_digits(start, changed):
    """The angle is that of small counts, to the bit."""
    sign, wraps = -1 if "inverted" in changed else 1, changed.get("wraps", 0)
    angles = []
    for first in (start % COUNTS, start):
        counts = [sign * (first + count) for count in range(0, 2100, 7)]
        sent = [count % wraps for count in counts] if wraps else counts
        angle = filled(1_000_000 * np.arange(300), sent, **changed)
        angles.append(angle.take(0, angle.available))
    if not wraps:
        assert np.array_equal(*angles)
    assert_allclose(*np.diff(angles), atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *(
            (lambda count=count: filled([0], [count]), r"^counter of .* at 0 ns; allowed: finite numbers up to 2\^64$")
            for count in (np.nan, -np.inf, 1e20, 10**250)
        ),
        (
            lambda: filled([0, 5_000_000, 20_500_000], [0, 1, 9]),
            "^no counts from 0.005 to 0.0205 s, .*max_gap = 10 ms$",
        ),
        (lambda: filled(np.arange(6) * STEP_NS, [10, 12, 11, 10, 13, 10]), "back by 3 counts at .* max_reverse = 2"),
    ],
)
def test_readings_that_no_encoder_gives_are_an_error(make, message):
    with pytest.raises(LatheError, match=message):
        make()


def test_the_angle_stands_while_the_counter_trembles():
    angle = filled(np.arange(5) * STEP_NS, [10, 12, 11, 10, 13])
    assert_allclose(angle.take(0, 5) * COUNTS / TURN, [10, 12, 12, 12, 13])


def test_a_reading_that_comes_after_a_younger_one_is_left_out_and_counted():
    angle = filled([0, 4 * STEP_NS, 2 * STEP_NS, 4 * STEP_NS, 6 * STEP_NS], [0, 4, 100, 100, 6])
    assert angle.late == 2
    assert_allclose(angle.take(0, 7) * COUNTS / TURN, np.arange(7))


@given(st.floats(0.0, 1.5 * TURN), st.integers(0, 2**32 - 1))
def test_the_end_is_the_first_sample_that_has_reached_the_angle(wanted, seed):
    random = np.random.default_rng(seed)
    angle = filled(np.cumsum(random.integers(1, 100_000, 200)), np.cumsum(random.integers(0, 12, 200)))
    found, whole = angle.reached(wanted), angle.take(0, angle.available)
    past = np.flatnonzero(whole >= wanted)
    assert found == (int(past[0]) if past.size else None)


# --- times of edges

CLOCK_NS = 1000


def read_out(every_ns, seconds=0.1, counts=COUNTS, law=LAW):
    """Readings of an encoder with edge times: time, count, and the last edge rounded down to the clock, both in ns."""
    edges = np.arange(0.0, seconds, 1e-6)
    passed = np.floor(law.at(edges)[0] * counts / TURN)
    # The law is inverted on a grid of 1 µs, then by its speed: to much less than the clock.
    first = np.searchsorted(passed, np.arange(1, passed[-1] + 1))
    angle, rate, _ = law.at(edges[first])
    stamps = edges[first] - (angle - np.arange(1, passed[-1] + 1) * TURN / counts) / rate
    stamps = np.append(0.0, stamps) * 1e9
    times = np.arange(0, round(stamps[-1]), every_ns)
    shown = np.searchsorted(stamps, times, side="right") - 1
    return times, shown, (np.floor(stamps[shown] / CLOCK_NS) * CLOCK_NS).astype(int)


def timed(times, counts, edges, **changed):
    """The angle by readings with edge times."""
    angle = filled([], [], **changed, edge_clock=CLOCK_NS * 1e-9)
    for reading in zip(times.tolist(), counts.tolist(), edges.tolist(), strict=True):
        angle.add(*reading)
    return angle


@pytest.mark.parametrize(("every_ns", "counts"), [(STEP_NS, 1000), (STEP_NS, 4096), (100_000, 4096)])
def test_edge_times_replace_the_rounding_to_a_count(every_ns, counts):
    """The angle errs by two ticks of the clock in place of a count."""
    times, shown, edges = read_out(every_ns, counts=counts)
    plain, better = filled(times, shown, counts), timed(times, shown, edges, of=counts)
    true = LAW.at(np.arange(plain.available) * STEP_NS * 1e-9)[0]
    errors = [np.abs(angle.take(0, plain.available) - true)[64:].max() for angle in (plain, better)]
    assert errors[0] > 0.9 * TURN / counts
    assert errors[1] < 2.2 * 105.0 * 1e-6


def test_edge_times_of_a_counter_that_wraps_and_counts_down():
    times, shown, edges = read_out(STEP_NS)
    plain = timed(times, shown, edges)
    other = timed(times, (5 - shown) % 2**16, edges, wraps=2**16, inverted=True)
    difference = other.take(0, plain.available) - plain.take(0, plain.available)
    assert_allclose(difference, difference[0], atol=1e-9)


def test_angle_stays_within_a_count_of_a_spindle_that_stops_or_trembles():
    """The edge of a counter that goes back and forth is passed again later: the angle does not fall."""
    times = np.arange(10) * STEP_NS
    counts, edges = np.array([0, 1, 2, 3, 2, 3, 3, 3, 3, 3]), times - 5000
    edges[6:] = edges[5]
    angle = timed(times, counts, edges).take(0, 10) * COUNTS / TURN
    assert np.all(np.diff(angle) >= 0.0)
    assert np.all((angle >= np.maximum.accumulate(counts)) & (angle < 4.0))


def test_an_edge_after_its_reading_is_an_error():
    with pytest.raises(LatheError, match=r"^last edge at 20 ns in a reading at 10 ns; allowed: not after the reading$"):
        timed(np.array([10]), np.array([1]), np.array([20]))


@pytest.mark.parametrize("change", [lambda ns: ns - 1_000_000, lambda ns: ns - 10 * 10**9, lambda ns: ns // 1000])
def test_edge_times_of_another_clock_or_unit_are_an_error(change):
    times, shown, edges = read_out(STEP_NS)
    allowed = (
        r"^last edge at .* of a count that had not come at \d+ ns; allowed: from -?\d+ ns on .* edge_clock = 1e-06 s"
    )
    with pytest.raises(LatheError, match=allowed):
        timed(times, shown, change(edges))


@given(st.integers(0, CLOCK_NS - 1))
def test_the_edge_of_a_new_count_may_be_rounded_to_before_the_last_reading(late):
    """The reading comes at any time of the clock's tick, the edge directly after it."""
    times = np.array([0, 10 * CLOCK_NS + late, 30 * CLOCK_NS])
    angle = timed(times, np.array([0, 0, 1]), np.array([0, 0, 10 * CLOCK_NS]))
    assert 1.0 <= angle.angle * COUNTS / TURN < 2.0


def test_lines_and_files_have_a_third_column_with_the_edge(path):
    text = b"time_ns,counts,edge_ns\n10,1,8\n20; 2; 15\n"
    assert list(LineReader(io.BytesIO(text), "line", timed=True).read()) == [(10, 1, 8), (20, 2, 15)]
    lacking = LineReader(io.BytesIO(b"10,1\n"), "line", timed=True)
    assert_refused(lambda: list(lacking.read()), "'10,1'; allowed: .* its last edge, as time_ns,counts,edge_ns")
    path.write_text("time_s,counts,edge_s\n1e-8,1,0.000000008\n2e-8,2,1.5e-8\n")
    reader = CsvReader(path)
    assert reader.timed
    assert list(reader.read()) == [(10, 1, 8), (20, 2, 15)]


# --- a cell that follows a file


def write_counts(path, seconds=0.4, every=5e-4, law=LAW, first=7 * 10**17):
    """The readings of a real encoder of `COUNTS` counts."""
    times = np.arange(0.0, seconds, every)
    counts = np.floor(law.at(times)[0] * COUNTS / TURN)
    rows = [f"{first + round(time * 1e9)},{count:.0f}" for time, count in zip(times, counts, strict=True)]
    path.write_text("\n".join(["time_ns,counts", *rows]))
    return times[-1]


def follower(path, **changed):
    """The smallest cell with an encoder in the place of the spindle."""
    device = {"source": "file", "counts_file": str(path), "counts_per_revolution": COUNTS, "revolutions": 5.0}
    nodes = dict(scenario(encoder_device=device | changed, learning_controller={"feedback_delay": 2048}).nodes)
    del nodes["spindle_encoder"]
    return Scenario("device", nodes)


def test_a_cell_learns_by_a_file_of_counts(path):
    write_counts(path)
    result = harness.run(follower(path))
    signals = encoder(result)
    true = LAW.at(np.arange(result.samples) * STEP_NS * 1e-9)
    assert np.abs(signals["angle"] - true[0]).max() < 2.1 * TURN / COUNTS
    assert signals["angle"][-1] < 5 * TURN <= signals["angle"][-1] + 2 * TURN / COUNTS
    assert np.flatnonzero(signals["index_pulse"]).size == 5
    window = 64 * STEP_NS * 1e-9
    behind = (signals["angle"][64:] - signals["angle"][:-64]) / window
    assert np.array_equal(signals["speed"][64:], behind)
    assert np.abs(signals["speed"] - true[1]).max() < 2.2 * TURN / COUNTS / window
    assert result.errors.rms[-1] < 0.1 * result.errors.rms[0]


def test_a_run_is_as_long_as_its_file_in_blocks_of_any_size(path):
    last = write_counts(path, 0.1)
    cell = follower(path, revolutions=0.0)
    whole = harness.run(cell)
    assert whole.samples == round(last * 1e9) // STEP_NS + 1
    other = Scenario("device", {n: t.model_copy(update={"block_size": 37}) for n, t in cell.nodes.items()})
    assert harness.run(other).digest == whole.digest


def test_events_tell_of_speeds_that_the_checks_did_not_count_on(path):
    write_counts(path, 0.2)
    result = harness.run(follower(path, revolutions=2.0, max_deviation=0.02))
    said = [found.text.partition(":")[0] for found in result.event_log if found.topic == "/encoder_device/events"]
    assert sorted(said) == ["too fast", "too slow"]


def test_a_file_of_counts_is_part_of_the_scenario(path):
    cell, ids = path.with_name("cell.yaml"), set()
    device = "{source: file, counts_file: counts.csv, counts_per_revolution: 1000}"
    cell.write_text(f"/encoder_device: {{ros__parameters: {device}}}")
    for seconds in (0.1, 0.09):
        write_counts(path, seconds)
        loaded = scenarios.load(cell)
        ids.add(loaded.shared.run_id)
    assert len(ids) == 2
    assert harness.run(loaded).samples > 5000


EVENT = {"allow_faults": True, "events": ["revolution 1: repair encoder"]}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"revolutions": 50.0}, r"at 0.0995 s, after 1\.6\d+ revolutions; encoder_device.revolutions = 50, allowed"),
        ({"max_gap": 1e-4}, r"counts.csv:3: no counts from 0 to 0.0005 s, for 0.5 ms; allowed: up to max_gap = 0.1 ms"),
        ({"inverted": True}, r"counts.csv:3: the encoder has gone back by"),
        ({"max_deviation": 0.9}, "at 199 rad/s the cycle leaves"),
        ({"counts_file": ""}, r"encoder_device.counts_file is empty with source = file; allowed: a name"),
        ({"source": "line"}, r"encoder_device.device is empty with source = line; allowed: a name"),
        ({"source": "topic", "speed_factor": 0.0}, r"speed_factor = 0 with source = topic; allowed: 1"),
        ({"source": "topic"}, r"follows a device, which a node hears; allowed: --mode composed or processes"),
        ({"source": "topic", "revolutions": 0.0}, r"encoder_device.revolutions = 0; this run needs an end"),
        ({"source": "topic", **EVENT}, r"nobody knows when 1 rev"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(path, changed, message):
    write_counts(path, 0.1)
    assert_refused(lambda: harness.run(follower(path, **{"revolutions": 1.0, **changed})), message)


def write_edges(path, every_ns):
    """The readings of an encoder with edge times."""
    rows = [f"{time},{count},{edge}" for time, count, edge in zip(*read_out(every_ns, 0.2), strict=True)]
    path.write_text("\n".join(["time_ns,counts,edge_ns", *rows]))


def test_a_cell_follows_a_file_with_edge_times_in_blocks_of_any_size(path):
    write_edges(path, STEP_NS)
    cell = follower(path, revolutions=0.0, edge_clock=CLOCK_NS * 1e-9)
    whole = harness.run(cell)
    error = encoder(whole)["angle"] - LAW.at(np.arange(whole.samples) * STEP_NS * 1e-9)[0]
    assert np.abs(error[64:]).max() < 2.2 * 105.0 * 1e-6
    other = Scenario("device", {n: t.model_copy(update={"block_size": 37}) for n, t in cell.nodes.items()})
    assert harness.run(other).digest == whole.digest
    unresolved = r"edge_clock = 0, and .*counts.csv has times of edges; allowed: their resolution, such as 1e-6"
    assert_refused(lambda: harness.run(follower(path, revolutions=0.0)), unresolved)
    write_counts(path, 0.1)
    untimed = r"edge_clock = 1e-06 s, and .*counts.csv has no times of edges; allowed: 0, or a third column edge_ns"
    assert_refused(lambda: harness.run(follower(path, revolutions=0.0, edge_clock=1e-6)), untimed)


def test_what_its_file_or_its_controller_cannot_have_is_refused(path):
    write_counts(path, 0.1)
    nodes = dict(follower(path, revolutions=1.0).nodes)
    nodes["learning_controller"] = nodes["learning_controller"].model_copy(update={"lead_law": "exact_preview"})
    unknown = "exact_preview, but nobody knows the speed of encoder_device in advance"
    assert_refused(lambda: harness.run(Scenario("device", nodes)), unknown)
    path.write_text("time_ns,counts\n0,0\n1000000,17\n2000000,33\n1900000,40\n")
    late = "counts.csv:5: a reading that is not later than the one before; allowed: times that rise"
    assert_refused(lambda: harness.run(follower(path, revolutions=0.0)), late)


# --- files that are not what they seem


def turning(seconds=0.5, rpm=1000.0, counts=COUNTS):
    """Times once a millisecond [s], and the counts of a spindle whose speed swings by 3 %."""
    time = np.arange(0.0, seconds, 1e-3)
    turns = rpm / 60.0 * (time + 0.03 * (1.0 - np.cos(40.0 * time)) / 40.0)
    return time, np.floor(turns * counts).astype(int)


def changed_at(place, by):
    """Counts with one reading or all later ones changed."""
    time, counts = turning()
    counts[place] += by
    return time, counts


def in_bursts(readings, apart):
    """Readings that come together, ``apart`` seconds from one to the next."""
    time, counts = turning()
    place = np.arange(time.size)
    return (place // readings + 1) * readings * 1e-3 + apart * (place % readings), counts


def zeroed_at(place):
    time, counts = turning()
    counts[place:] -= counts[place]
    return time, counts


@pytest.mark.parametrize(
    ("made", "changed", "message"),
    [
        *(
            (
                turning(counts=of),
                {},
                rf"rpm on average is {said} nominal_rpm = 1000; .*counts_per_revolution = {of}, or",
            )
            for of, said in (
                (250, r"a quarter \(x1 for x4\?\) of"),
                (500, r"half \(x2 for x4\?\) of"),
                (2000, r"twice \(x4 for x2\?\)"),
                (4000, r"four times \(x4 for x1\?\)"),
            )
        ),
        (turning(rpm=700.0), {}, r"70\d\.\d rpm on average is 0\.70\d of .*allowed: within max_deviation = 0\.2"),
        *(
            ((turning()[0], (turning()[1] + half) % wraps - half), {}, rf"anew{often}: counter_range = {wraps}\)$")
            for wraps, half, often in ((2**12, 0, ""), (2**12, 2**11, ""), (1000, 0, ", by its index\\?"))
        ),
        (zeroed_at(33), {}, r"counts.csv:35: .* gone back by .* at 0.033 s; .*\(the counter was zeroed or set"),
        *(
            (changed_at(at, by), {}, rf"counts.csv:102: the counter runs ahead by {by + 16} counts from 0.099 to 0.1 s")
            for at, by in ((slice(100, None), 400), (100, 1000), (100, 2**16))
        ),
        (changed_at(100, 22), {}, r"counts.csv:103: the counter jumps ahead at 0.1 s and back by \d counts at 0.101 s"),
        (changed_at(100, -200), {}, r"counts.csv:102: the encoder has gone back by 18\d counts at 0.1 s"),
        *(
            (in_bursts(*burst), {"max_gap": 0.1}, "time stamps come in bursts: .* allowed: the time at which")
            for burst in ((16, 0.0), (16, 2e-5), (4, 1e-5), (2, 1e-5), (64, 1e-6))
        ),
    ],
)
def test_a_file_that_is_not_what_it_seems_is_refused_by_its_cause(path, made, changed, message):
    """Counts per revolution, counters that begin anew or are set, spikes at their own reading, bursts of stamps."""
    rows = (f"{time:.6f},{count}\n" for time, count in zip(*made, strict=True))
    path.write_text("time_s,counts\n" + "".join(rows))
    assert_refused(lambda: EncoderDevice("encoder_device", follower(path, **changed).nodes["encoder_device"]), message)


@pytest.mark.parametrize("left", [3, 4, 9])
def test_a_last_line_that_is_torn_is_named(path, left):
    write_rows(path, turning()[1])
    *lines, last = path.read_text().splitlines()
    path.write_text("\n".join([*lines, last[:left]]))
    torn = r"counts.csv:501: .*\(the last line has no end: torn\? remove it\)"
    assert_refused(lambda: EncoderDevice("encoder_device", follower(path).nodes["encoder_device"]), torn)


def index_rows(path, counts, pulses, column):
    """A file whose index column has the newest pulse."""
    time = turning()[0]
    rows = []
    for at, count in zip(time, counts.tolist(), strict=True):
        come = [pulse for pulse in pulses if pulse <= count]
        value = come[-1] if come and column == "counts" else f"{np.interp(come[-1], counts, time):.6f}" if come else ""
        rows.append(f"{at:.6f},{count},{value}\n")
    path.write_text(f"time_s,counts,index_{column}\n" + "".join(rows))


@pytest.mark.parametrize("column", ["counts", "s"])
@pytest.mark.parametrize("share", [1.0, 15 / 16, 1000 / 1024, 31 / 32, 33 / 32])
def test_index_pulses_show_lost_counts_and_the_angle_zero(path, column, share):
    """Counts that are lost are refused with an index and told as a ratio without one."""
    counts = np.floor(turning()[1] * share).astype(int)
    pulses = np.round((np.arange(12) + 0.3) * COUNTS * share).astype(int).tolist()
    index_rows(path, counts, pulses, column)
    table = follower(path).nodes["encoder_device"]
    if share == 1.0:
        device = EncoderDevice("encoder_device", table)
        assert device.warnings(1.0) == []
        assert_allclose(device.counted.take(0, 1) * COUNTS / TURN, 0.7 * COUNTS, atol=2.0)
        return
    middle = f"{COUNTS * share:.4g}"[:2]
    lost = rf"counts from index pulse 1 to the next, and {middle}.* in the middle; allowed: counts_per_rev.* = 1000 "
    assert_refused(lambda: EncoderDevice("encoder_device", table), lost)
    write_rows(path, counts)
    (said,) = EncoderDevice("encoder_device", table).warnings(1.0)
    ratio = {1000 / 1024: "1000 for 1024 lines"}.get(share, f"{round(32 * share) if share != 15 / 16 else 15}/")
    assert f"({ratio}" in said


def test_one_index_pulse_shows_no_lost_counts_and_this_is_told(path):
    _, counts = turning()
    index_rows(path, counts, [300], "counts")
    (said,) = EncoderDevice("encoder_device", follower(path).nodes["encoder_device"]).warnings(1.0)
    assert said.endswith("1 index pulses: lost counts are not looked for; two or more show them")


def still(*pieces):
    """Counts once a millisecond: of each piece so many readings, and the counts from one to the next."""
    return np.cumsum(np.concatenate([np.full(readings, step, dtype=float) for readings, step in pieces])).astype(int)


def write_rows(path, counts):
    path.write_text("\n".join(["time_s,counts", *(f"{n / 1000},{count}" for n, count in enumerate(counts))]))


@pytest.mark.parametrize(
    "counts",
    [
        still((100, 0), (200, 17)),
        still((100, 17), (50, 0), (50, 17), (50, 0), (100, 17)),
        still((200, 17), (100, 0)),
        still((120, 17), (1, 0), (120, 17)),
        still((50, 0), (2, 1), (3, 0), (200, 17)),
        still((100, 0.01), (200, 17)),
        50 * (still((250, 17)) // 50),
    ],
)
def test_what_stands_still_is_turned_and_measured(path, counts):
    write_rows(path, counts)
    found = harness.run(follower(path, revolutions=0.0)).part
    assert found.form.rms.size == found.profile.shape[0] == int(counts[-1] / COUNTS + 1e-3) > 0
    assert np.all(np.isfinite(found.form.rms))
    assert np.abs(found.profile).max() < 1.1 * found.form.largest.max()
    assert_allclose(np.sqrt((found.profile**2).mean(axis=1)), found.form.rms, rtol=0.02)


def test_a_bag_with_a_standstill_goes_through_every_command(path, tmp_path):
    """The tachogram says how long the spindle stands; a re-simulation gives the events, too."""
    bag = tmp_path / "bag"
    write_rows(path, still((50, 0), (80, 17), (20, 0), (80, 17)))
    result = harness.run(follower(path, revolutions=0.0), bag=bag)
    assert [event.text.partition(":")[0] for event in result.event_log] == ["too slow"]
    assert not resimulate(bag).different
    info, stands = (
        json.loads(CliRunner().invoke(main, ["bag", *map(str, words), "--json"]).stdout)
        for words in (("info", bag), ("tachogram", bag, "-o", tmp_path / "speed.csv"))
    )
    rms = info["error_um"]["last"]["rms"]
    assert rms == pytest.approx(result.errors.rms[-1] * 1e6, rel=0.01)
    assert (stands["standstill"], stands["stands_from"]) == pytest.approx((0.067, 1e-3), abs=2e-4)
    form = FormByRevolution("/encoder", "/tool")
    stream.feed(bag, [form])
    form.finish()
    assert form.refused == ""
    assert form.last.numbers["rms"] == pytest.approx(rms, rel=0.01)
