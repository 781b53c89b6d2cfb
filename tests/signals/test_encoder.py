# SPDX-License-Identifier: Apache-2.0
"""Encoder: what is measured against what is true."""

from pathlib import Path

import numpy as np
import pytest
from cells import config, cuts, in_blocks, same
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_allclose

from lathe_machine.signals.encoder import Encoder, EncoderSamples
from lathe_machine.signals.encoder_errors import EncoderErrors, seen_along
from lathe_rc import harness, messages
from lathe_rc.analysis.metrology import undulations
from lathe_rc.cell import scenario
from lathe_rc.signals import speed

TURN = 2 * np.pi
STEP = 1 / 64000
NOMINAL = 1000 * TURN / 60
swinging = speed.harmonic(NOMINAL, np.array([0.1]), np.array([10.7]), np.array([0.5]))
laws = st.sampled_from([speed.constant(NOMINAL), swinging])
counts = st.one_of(st.integers(1, 100), st.integers(101, 2**31 - 1))


def test_samples_are_named_in_the_order_of_the_message():
    assert EncoderSamples._fields == tuple(messages.sample_fields(messages.ENCODER))


def measure(law, counts=0, window=64, lengths=(12000,), errors=EncoderErrors(), **kwargs):  # noqa: B008 - it never changes
    """Signals of an encoder that works in blocks of ``lengths``."""
    signals = messages.allocate(messages.ENCODER, sum(lengths))
    encoder = Encoder(law, STEP, counts, window, errors, **kwargs)
    in_blocks(lengths, encoder.block, *signals.values())
    return signals


@given(laws)
def test_ideal_encoder_measures_the_truth_which_is_the_law(law):
    signals = measure(law)
    angle, rate, _ = law.at(np.arange(12000) * STEP)
    for name, expected in (("angle", angle), ("speed", rate)):
        assert np.array_equal(signals[f"{name}_true"], expected)
        assert np.array_equal(signals[name], expected)


@given(laws, st.one_of(st.just(0), counts))
def test_index_pulse_comes_from_sample_0_with_the_count_that_ends_a_revolution(law, counts):
    signals = measure(law, counts)
    revolution = np.rint(signals["angle"] * counts / TURN) // counts if counts else signals["angle_true"] // TURN
    assert np.array_equal(signals["index_pulse"], np.diff(revolution, prepend=-1.0))
    assert signals["index_pulse"].sum() == 4


@given(laws, counts)
def test_counts_lag_by_less_than_one(law, counts):
    signals = measure(law, counts)
    lag = signals["angle_true"] - signals["angle"]
    rounding = 1e-13
    assert lag.min() >= -rounding
    assert lag.max() < TURN / counts + rounding
    assert_allclose(signals["angle"] * counts / TURN, np.rint(signals["angle"] * counts / TURN), rtol=1e-14)


@given(st.integers(500, 100_000), st.integers(1, 500))
def test_mean_of_the_measured_speed_is_true(counts, window):
    measured = measure(speed.constant(NOMINAL), counts, window)["speed"]
    assert abs(measured.mean() - NOMINAL) <= TURN / counts / (measured.size * STEP)


def test_measured_speed_lags_by_half_its_window():
    ramp = speed.tachogram(NOMINAL, np.array([0.0, 10.0]), np.array([0.0, 1.0]))
    signals, window = measure(ramp, counts=2**30, window=100), 100
    middle = (np.arange(window, 12000) - window / 2) * STEP
    assert_allclose(signals["speed"][window:], ramp.at(middle)[1], rtol=1e-6)


# --- errors of the disc and the signals

EVEN = speed.constant(TURN / (3840 * STEP))  # 3840 samples a revolution
PERIODS = 32


def misread(errors, counts=0, lengths=(3840,), law=EVEN):
    """Signals of an encoder with errors, by default of a revolution."""
    return measure(law, counts, lengths=lengths, errors=errors)


def waves(signals):
    """Amplitude of what is seen less what is true, by waves a revolution."""
    error = signals["angle"] - signals["angle_true"]
    return 2 * np.abs(np.fft.rfft(error)) / error.size


def test_eccentric_disc_errs_once_a_revolution_by_its_eccentricity():
    errors = EncoderErrors(eccentricity=2e-4, phase=0.6)
    signals = misread(errors)
    true = signals["angle_true"]
    assert_allclose(signals["angle"] - true, 2e-4 * (np.sin(true + 0.6) - np.sin(0.6)), atol=1e-14)
    assert signals["index_pulse"].sum() == signals["index_pulse"][0] == 1


@pytest.mark.parametrize(
    ("values", "wave", "amplitude"),
    [
        ({"cosine_offset": 3e-3, "sine_offset": -4e-3}, PERIODS, 5e-3 / PERIODS),
        ({"mismatch": 6e-3, "skew": 8e-3}, 2 * PERIODS, 1e-2 / (2 * PERIODS)),
    ],
)
def test_signals_that_are_no_circle_err_within_a_period(values, wave, amplitude):
    """Heydemann's ellipse: offsets err once in a signal period, amplitudes and phase twice."""
    found = waves(misread(EncoderErrors(periods=PERIODS, **values)))
    assert found[wave] == pytest.approx(amplitude, rel=0.01)
    found[[0, wave]] = 0.0
    assert found.max() < 0.02 * amplitude


ALL_WRONG = EncoderErrors(
    eccentricity=1e-3, phase=-1.0, periods=PERIODS, cosine_offset=0.05, sine_offset=0.02, mismatch=-0.1, skew=0.1
)


def test_speed_is_the_rate_of_the_angle_that_is_seen():
    signals = misread(ALL_WRONG, law=swinging)
    rate = np.gradient(signals["angle"], STEP)
    assert_allclose(signals["speed"][1:-1], rate[1:-1], rtol=1e-3)
    assert np.ptp(signals["speed"] / signals["speed_true"]) > 0.2


@given(counts, cuts)
def test_counts_round_what_is_seen_and_cuts_change_nothing(count, lengths):
    exact, rounded = misread(ALL_WRONG, 0, lengths), misread(ALL_WRONG, count, lengths)
    lag = exact["angle"] - rounded["angle"]
    assert -1e-13 <= lag.min() <= lag.max() < TURN / count + 1e-13
    assert same(rounded, misread(ALL_WRONG, count, [sum(lengths)]))


@refusals(
    (EncoderErrors(eccentricity=0.6).check, "encoder: eccentricity 0.6 rad; allowed: up to 0.5 rad"),
    (EncoderErrors(periods=0).check, "encoder: 0 signal periods in a revolution; allowed: 1 or more"),
    (EncoderErrors(mismatch=-0.3, skew=0.3).check, "encoder: errors of the signals that come to 0.6; allowed: "),
)
def test_errors_that_would_turn_the_angle_back_are_refused(make, message):
    assert_refused(make, message)


def test_learning_leaves_what_the_encoder_misreads():
    """Of an oval A·sin 2φ an eccentric disc leaves A·e at 1 and at 3 undulations: no controller can see it."""
    plain = ["spindle_encoder.revolutions=12.0", "spindle_encoder.deviation_amplitude=[]",
             "spindle_encoder.deviation_frequency=[]", "tool.profile=harmonics"]  # fmt: skip
    profiles = []
    for eccentricity in (0.0, 2e-3):
        config = Path(__file__).parents[2] / "config" / "piston.yaml"
        loaded = scenario.load(config, [*plain, f"spindle_encoder.disc_eccentricity={eccentricity}"])
        profiles.append(harness.run(loaded).part.profile[-1])
    found = undulations((profiles[1] - profiles[0])[None, :], 6).amplitude[0]
    assert_allclose(found[[1, 3]], 225e-6 * 2e-3, rtol=0.02)
    assert max(found[2], *found[4:]) < 0.02 * found[1]


# --- times of the edges

CLOCK = 1e-6  # [s]
RESOLVED = st.integers(200, 200_000)


def timed(law, counts, clock=CLOCK, **kwargs):
    """Signals of an encoder that gives the times of its edges."""
    return measure(law, counts, edge_clock=clock, **kwargs)


@given(laws, RESOLVED)
def test_angle_with_edge_times_errs_by_ticks_of_their_clock_instead_of_counts(law, counts):
    """The stamp is up to a tick early; the rate between two edges errs by up to a tick on the way from edge to edge."""
    signals, begins = timed(law, counts), 4 + round(4 * TURN / counts / NOMINAL / STEP)  # two edges after sample 0
    lag = (signals["angle_true"] - signals["angle"])[begins:]
    tick, bent = 1.1 * NOMINAL * CLOCK, 0.1 * NOMINAL * 10.7 * max(STEP, TURN / counts / NOMINAL) ** 2
    assert -tick - 2 * bent < lag.min()
    assert lag.max() < min(2 * tick + 2 * bent, TURN / counts + 1e-12)


@given(laws, st.one_of(st.integers(1, 199), RESOLVED), st.sampled_from([1e-8, CLOCK, STEP / 2, 1e-3]))
def test_edge_times_keep_the_count_and_the_index_pulse(law, counts, clock):
    """The angle is between the count and the next one, and never falls."""
    plain, signals = measure(law, counts), timed(law, counts, clock)
    assert np.array_equal(signals["index_pulse"], plain["index_pulse"])
    parts = (signals["angle"] - plain["angle"]) * counts / TURN
    assert -1e-9 < parts.min() <= parts.max() < 1.0
    assert np.diff(signals["angle"]).min() >= 0.0


def test_a_clock_coarser_than_a_count_adds_nothing_wrong():
    signals = timed(swinging, 100_000, clock=5e-6)
    lag = signals["angle_true"] - signals["angle"]
    assert -1e-12 < lag.min() <= lag.max() < TURN / 100_000


@given(laws, RESOLVED, cuts)
def test_cuts_change_no_bit_of_an_angle_with_edge_times(law, counts, lengths):
    assert same(timed(law, counts, lengths=lengths), timed(law, counts, lengths=[sum(lengths)]))


def test_an_edge_is_known_only_after_it():
    """A later change of the speed changes no earlier sample."""
    later = speed.harmonic(NOMINAL, np.array([0.1]), np.array([300.0]), np.zeros(1), 0.1)
    both = [timed(law, 4096)["angle"] for law in (speed.constant(NOMINAL), later)]
    until = round(0.1 / STEP)
    assert np.array_equal(both[0][:until], both[1][:until])
    assert not np.array_equal(*both)


@pytest.mark.parametrize("counts", [900, 4096, 30_000])
@pytest.mark.parametrize("errors", [EncoderErrors(), ALL_WRONG])
def test_stamp_is_the_time_at_which_the_disc_passes_its_edge(counts, errors):
    """Compared with bisection of the speed law through the errors of disc and signals."""
    clock, law = 1e-10, speed.harmonic(NOMINAL, np.array([0.1]), np.array([300.0]), np.zeros(1))
    encoder, table = Encoder(law, STEP, counts, 64, errors, clock), errors.table
    signals = messages.allocate(messages.ENCODER, 40_030)  # the speed changes quickly there
    encoder.block(0, *signals.values())
    stamp, count, _ = encoder.table.edges.last
    low, high = 39_000 * STEP, 40_029 * STEP
    for _ in range(60):
        middle = 0.5 * (low + high)
        true = law.at(middle)[0]
        reading = np.empty(1)
        seen_along(table, true, reading)
        low, high = (middle, high) if reading[0] < count * TURN / counts else (low, middle)
    assert stamp - clock <= high <= stamp + 2 * clock


@pytest.mark.parametrize("reads", [2, 16])
def test_counter_read_several_times_a_sample_times_its_edges(reads):
    """The stamp is that of the last reading without the edge, as of an encoder read at so many times the rate."""
    encoder, fast = Encoder(swinging, STEP, 4096, 64, edge_clock=STEP / reads), measure_at(STEP / reads, 4096, 64_000)
    changed = np.flatnonzero(np.diff(fast)) + 1  # the first reading with the new count
    for n in range(600):
        encoder.block(n, *messages.allocate(messages.ENCODER, 1).values())
        last = changed[changed <= n * reads]
        if last.size:
            assert encoder.table.edges.last[0] == pytest.approx((last[-1] - 1) * STEP / reads, abs=1e-12)


def measure_at(step, counts, samples):
    """Counts of an encoder without edge times, at another sampling step."""
    return np.floor(swinging.at(np.arange(samples) * step)[0] * counts / TURN)


def test_several_reads_are_an_edge_clock_for_the_law():
    law = config("robust", "spindle_encoder.reads_per_sample=16").nodes["disturbance_controller"]
    assert law.encoder_edge_clock == STEP / 16
