# SPDX-License-Identifier: Apache-2.0
"""Form errors and roundness, revolution by revolution, and profiles as files."""

import json
import math

import numpy as np
import pytest
from cells import config
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.signals.measured_profile import read_csv
from lathe_machine.signals.profile import Harmonics
from lathe_rc import cli, harness, messages
from lathe_rc.analysis import profile_csv
from lathe_rc.analysis.metrology import POINTS, evenly, gaussian, lay, measure, roughness, roundness, undulations
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.errors import InputError
from lathe_rc.signals import speed
from lathe_rc.signals.form_errors import RunningErrors, form_errors, that_count

TURN = 2 * np.pi
EVEN = np.arange(POINTS) * (TURN / POINTS)

amplitudes = st.floats(1e-9, 1e-4)
phases = st.floats(-3.1, 3.1)


def steady(revolutions, samples=1000):
    """Angles at a steady speed, ``samples`` a revolution."""
    return np.arange(round(revolutions * samples)) * (TURN / samples)


def test_sine_has_its_rms_and_largest():
    angle = steady(3)
    found = form_errors(angle, np.floor(angle / TURN + 1e-9) * np.sin(4 * angle) + 0.5)
    assert_allclose(found.rms, np.sqrt(np.arange(3) ** 2 / 2 + 0.25))
    assert_allclose(found.largest, [0.5, 1.5, 2.5], rtol=1e-4)
    assert_allclose(found.peak_to_valley, [0.0, 2.0, 4.0], rtol=1e-4)
    assert list(found.starts) == [0, 1000, 2000, 3000]


@given(st.integers(2, 5000).filter(lambda samples: samples % 1000 != 999))  # there rounding decides
def test_incomplete_revolution_is_left_out(samples):
    complete = samples // 1000
    angle = steady(samples / 1000)
    found = form_errors(angle, np.where(np.arange(samples) < complete * 1000, 1.0, 100.0))
    assert_allclose(found.rms, np.ones(complete))
    assert_allclose(found.largest, np.ones(complete))
    assert_allclose(found.peak_to_valley, np.zeros(complete))
    assert list(found.starts) == [1000 * revolution for revolution in range(complete + 1)]


def test_last_sample_before_the_end_completes_a_revolution():
    """A run of whole revolutions ends before the first sample of the next; even angles cover the same revolutions."""
    angle = np.arange(0.0, 2 * TURN, 0.01)
    for missing, revolutions in ((0, 2), (2, 1), (3, 1)):
        part = angle[: angle.size - missing]
        assert form_errors(part, part).rms.size == revolutions
        assert evenly(part, part, 64).shape == (revolutions, 64)


@pytest.mark.parametrize("begin", [0.3, 2.5])
def test_a_snapshot_begins_with_its_first_complete_revolution(begin):
    """Also one that begins in the first, and after missing samples."""
    angle, at = steady(6), round(begin * 1000)
    error, types = np.sin(np.arange(angle.size) ** 2.0), {"encoder": messages.ENCODER, "tool": messages.TOOL}
    whole = form_errors(angle, error)
    for pieces in ([(at, 6000)], [(0, at - 100), (at, 4000), (4000, 6000)]):
        form = RunningForm.of(types)
        for first, end in pieces:
            piece = slice(first, end)
            dense = {"encoder": {"angle_true": angle[piece]}, "tool": {"error": error[piece]}}
            form.chunk(first, end - first, dense, {})
        assert form.before == math.ceil(begin)
        assert_array_equal(form.largest, whole.largest[form.before :])


def test_revolution_without_a_sample_is_refused():
    with pytest.raises(InputError, match=r"^revolution \d+ has no sample; allowed: an angle that increases by less th"):
        form_errors(np.arange(200) * 2.0 * np.pi / 0.7, np.ones(200))


@given(
    first=st.integers(0, 2),
    begin=st.floats(0.0, 2.0),
    steps=st.lists(st.floats(1e-3, 0.9), min_size=1, max_size=300),
    cuts=st.lists(st.integers(0, 300), max_size=5),
)
def test_errors_of_pieces_are_those_of_the_whole_and_each_is_its_sum(first, begin, steps, cuts):
    turns = begin + np.cumsum(steps)
    angle, error = turns * TURN, np.sin(np.arange(turns.size) ** 2.0)
    running = RunningErrors(max(first, math.ceil(angle[0] / TURN)))
    for piece in np.split(np.arange(turns.size), sorted(cuts)):
        running.add(angle[piece], error[piece])
    found, whole = running.found(), form_errors(angle, error, max(first, math.ceil(angle[0] / TURN)))
    for name in ("rms", "largest", "peak_to_valley", "starts"):
        assert_array_equal(getattr(found, name), getattr(whole, name))
    turns = angle / TURN
    goes = np.append(np.diff(turns), np.diff(turns)[-1:])
    for a, b, rms, largest in zip(found.starts, found.starts[1:], found.rms, found.largest, strict=False):
        assert rms == pytest.approx(np.sqrt(np.average(error[a:b] ** 2, weights=goes[a:b])), rel=1e-12)
        assert largest == np.abs(error[a:b]).max()


# --- even angles


def wandering(swing, revolutions=2.05):
    """Angles at 64 kHz of a spindle whose speed swings."""
    law = speed.harmonic(104.72, np.array([swing]), np.array([150.0]), np.array([0.3]))
    return law.at(np.arange(law.samples_until(revolutions * TURN, 1 / 64_000)) / 64_000)[0]


def test_end_of_a_run_holds_its_last_value():
    angle = steady(2)[:-1]
    assert_allclose(evenly(angle, angle, 1000)[-1, -1], angle[-1])
    assert_allclose(evenly(angle, angle, 1000)[-1, :-1], angle[1000:])


@pytest.mark.parametrize("samples", [0, 1, 2, 5])
def test_very_short_run_has_nothing_to_measure(samples):
    found = measure(np.arange(samples) * 1e-3, np.ones(samples))
    assert found.profile.shape == (0, POINTS)
    assert found.roundness.rms.size == found.roughness.ra.size == found.form.rms.size == 0
    assert found.undulations.amplitude.shape == (0, 51)
    assert list(found.form.starts) == [0]
    assert measure(np.full(samples, 0.5), np.ones(samples)).form.rms.size == 0


def test_angle_of_an_encoder_is_refused():
    assert_refused(lambda: evenly(steady(1) - 0.01 * (np.arange(1000) >= 501), np.ones(1000)), "sample 500")
    assert_refused(lambda: evenly(steady(1), np.ones(1000), 2), "2 points")


@pytest.mark.parametrize("stands", [[0], [1], [400], [998, 999], [0, 700, 701, 1500], list(range(0, 2000, 2))])
@pytest.mark.parametrize("samples", [1, 3, 50])
def test_a_standstill_leaves_no_trace_in_the_form(stands, samples):
    """A standstill leaves no trace in the form error.

    Nor does what the tool does meanwhile, before it leaves the place; the step after it is as short as it may be.
    """
    angle = steady(2) + 1e-9
    values = 10e-6 * np.sin(3 * angle)
    repeats = np.ones(angle.size, int)
    repeats[stands] += samples
    standing, moved = np.repeat(angle, repeats), np.repeat(values, repeats)
    last = np.cumsum(repeats) - 1
    moved[np.setdiff1d(np.arange(moved.size), last)] += 1e-6
    standing[last[stands]] += 1e-12
    found, plain = (measure(a, e) for a, e in ((standing, moved), (angle, values)))
    assert_allclose(found.profile, plain.profile, atol=5e-9)
    assert_allclose(found.form.rms, plain.form.rms, rtol=1e-6)
    kept = that_count(*(signal[:samples] for signal in (np.full(2000, 1.0), moved)))
    assert moved[:samples][kept].max() == moved[:samples].max()


# --- undulations


@given(st.dictionaries(st.integers(1, 50), st.tuples(amplitudes, phases), min_size=1, max_size=5))
def test_undulations_are_the_harmonics_of_a_profile(content):
    """In the convention of the profiles of the cell, one by one, whatever else is there; the mean is harmonic 0."""
    order = np.array(list(content))
    amplitude, phase = np.array(list(content.values())).T
    found = undulations(Harmonics(order, amplitude, phase).deviation(EVEN, 0.0)[None] - amplitude[0], 50)
    assert_allclose(found.amplitude[0, 0] * np.sin(found.phase[0, 0]), -amplitude[0])
    found.amplitude[0, 0] = 0.0
    assert_allclose(found.amplitude[0, order], amplitude, atol=1e-17)
    assert_allclose(np.exp(1j * found.phase[0, order]), np.exp(1j * phase), atol=1e-6)
    others = np.setdiff1d(np.arange(51), order)
    assert found.amplitude[0, others].max() < 1e-17


def test_too_many_undulations_are_refused():
    assert undulations(np.zeros((1, 64)), 31).amplitude.shape == (1, 32)
    for highest in (32, -1):
        assert_refused(lambda n=highest: undulations(np.zeros((1, 64)), n), f"up to {highest} UPR of 64 points")


# --- Gaussian filter


@given(st.integers(1, 500), st.sampled_from([15.0, 50.0, 150.0, 500.0]))
def test_gaussian_keeps_half_at_its_cutoff(waves, cutoff):
    wave = np.sin(waves * EVEN)
    assert_allclose(gaussian(wave, cutoff), 0.5 ** ((waves / cutoff) ** 2) * wave, atol=1e-12)


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 146.3, np.nan])
def test_cutoff_without_enough_points_is_refused(cutoff):
    assert gaussian(np.ones(1024), 146.0).size == 1024
    assert_refused(lambda: gaussian(np.ones(1024), cutoff), "filter cut-off")


# --- roundness


@given(st.floats(0.0, 1e-3), phases, st.floats(0.01, 0.1))
def test_eccentric_circle_gives_back_its_centre(eccentricity, direction, radius):
    """A true circle about another centre: the axis sees e·cos(φ - α) + sqrt(R² - e²·sin²(φ - α))."""
    turned = EVEN - direction
    profile = eccentricity * np.cos(turned) + np.sqrt(radius**2 - (eccentricity * np.sin(turned)) ** 2)
    found = roundness(profile[None])
    assert_allclose(found.x, eccentricity * np.cos(direction), atol=1e-15)
    assert_allclose(found.y, eccentricity * np.sin(direction), atol=1e-15)
    assert_allclose(found.eccentricity, eccentricity, atol=1e-15)
    assert_allclose(found.radius, radius, atol=0.26 * eccentricity**2 / radius + 1e-15)
    assert_allclose(found.peak_to_valley, eccentricity**2 / (2 * radius), rtol=0.02, atol=1e-14)


def test_least_squares_circle_is_that_of_a_general_solver():
    profile = np.random.default_rng(2).normal(size=(3, 512))
    angle = np.arange(512) * (TURN / 512)
    terms = np.stack((np.ones(512), np.cos(angle), np.sin(angle)), axis=1)
    fit, squares, *_ = np.linalg.lstsq(terms, profile.T, rcond=None)
    found = roundness(profile)
    assert_allclose((found.radius, found.x, found.y), fit, atol=1e-12)
    assert_allclose(found.rms, np.sqrt(squares / 512))


def test_roundness_of_the_long_waves_leaves_chatter_out():
    chatter = 1e-6 * np.sin(200 * EVEN)
    lobes = 3e-6 * np.sin(3 * EVEN) + 1e-3 * np.cos(EVEN)
    found = roundness((lobes + chatter)[None], cutoff=50.0)
    assert_allclose(found.rms, 3e-6 / np.sqrt(2), rtol=4e-3)
    assert_allclose(found.x, 1e-3)
    assert roundness((lobes + chatter)[None]).rms > 1.05 * found.rms


# --- roughness


# Odd numbers of waves have their points at 4096 different places of a wave.
@given(amplitudes, st.integers(75, 249).map(lambda half: 2 * half + 1))
def test_roughness_of_a_sine(amplitude, waves):
    """Ra = 2A/π and Rq = A/√2; the oval beside it belongs to the form."""
    found = roughness((amplitude * np.sin(waves * EVEN) + 1e-4 * np.sin(2 * EVEN))[None], 50.0)
    # At 150 UPR the filter of 50 UPR takes 1/512 of the amplitude along; of the oval it leaves 0.1 % · A.
    oval = 1e-4 * (1 - 0.5 ** (2 / 50) ** 2)
    assert_allclose(found.ra, 2 * amplitude / np.pi, rtol=3e-3, atol=oval)
    assert_allclose(found.rq, np.hypot(amplitude, oval) / np.sqrt(2), rtol=3e-3)


# --- all together


@given(st.floats(0.0, 0.5))
def test_measurement_does_not_depend_on_the_speed(swing):
    """And the radius deviates by the opposite of the error: where that is positive, material is missing."""
    angle = wandering(swing)
    error = 5e-6 * np.cos(angle) + 2e-6 * np.sin(3 * angle + 0.4) + 0.1e-6 * np.sin(120 * angle)
    found = measure(angle, error, roughness_cutoff=30.0)
    assert_allclose(found.form.rms, np.sqrt((5e-6**2 + 2e-6**2 + 0.1e-6**2) / 2), rtol=1e-3)
    assert_allclose(found.roundness.rms, np.sqrt((2e-6**2 + 0.1e-6**2) / 2), rtol=1e-3)
    assert_allclose(found.roundness.x, -5e-6, rtol=1e-3)
    # A cubic spline errs by 5/384·h⁴ of the fourth derivative; ends count a little more.
    shape = 5e-6 * np.cos(EVEN) + 2e-6 * np.sin(3 * EVEN + 0.4) + 0.1e-6 * np.sin(120 * EVEN)
    assert_allclose(found.profile, np.tile(-shape, (2, 1)), atol=0.1e-6 * 0.1 * (120 * 3e-3) ** 4)
    assert_allclose(found.undulations.amplitude[:, [1, 3]], [[5e-6, 2e-6]] * 2, rtol=1e-6)
    assert_allclose(found.roughness.rq, 0.1e-6 / np.sqrt(2), rtol=0.02)


# --- files


@pytest.mark.parametrize("heights", [None, np.array([0.0, 0.25e-3, 0.5e-3])])
def test_profiles_can_be_read_back(tmp_path, heights):
    path = tmp_path / "profile.csv"
    radius = np.random.default_rng(4).normal(scale=1e-5, size=(1 if heights is None else heights.size, 90))
    profile_csv.write(
        path, radius[0] if heights is None else radius, heights=heights, comment="revolution 60\nof a run"
    )
    assert path.read_text().splitlines()[0] == "# revolution 60 of a run"
    back = read_csv(path)
    assert_allclose(back.angle, np.arange(90) * TURN / 90, atol=1e-12)
    assert_allclose(back.radius, radius, atol=1e-15)
    if heights is not None:
        assert_allclose(back.heights, heights)


@pytest.mark.parametrize(
    ("radius", "heights", "folder", "said"),
    [
        (np.array([0.0, np.nan, 0.0]), None, ".", "not finite"),
        (np.zeros((2, 8)), np.zeros(2), ".", "no feed"),
        (np.zeros((2, 8)), np.arange(3.0), ".", "2 revolutions and 3 heights"),
        (np.zeros(8), None, "nowhere", "No such file"),
    ],
)
def test_profiles_that_cannot_be_written_are_refused(tmp_path, radius, heights, folder, said):
    assert_refused(lambda: profile_csv.write(tmp_path / folder / "profile.csv", radius, heights=heights), said)
    assert list(tmp_path.iterdir()) == []


def test_revolutions_without_heights_are_numbered(tmp_path):
    profile_csv.write(tmp_path / "profile.csv", np.array([[1e-6, 2e-6, 3e-6], [4e-6, 5e-6, 6e-6]]))
    assert (tmp_path / "profile.csv").read_text().splitlines() == [
        "angle_deg,revolution,radius_um", "0,1,1", "120,1,2", "240,1,3", "0,2,4", "120,2,5", "240,2,6",
    ]  # fmt: skip
    assert_refused(lambda: read_csv(tmp_path / "profile.csv"), "a column of revolutions; allowed")


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_profile_is_written_whole_or_not_at_all(tmp_path, monkeypatch, fault):
    path = tmp_path / "profile.csv"
    path.write_text("before")

    def fail(file, *_, **__):
        file.write(b"angle_deg,rad")
        raise fault

    monkeypatch.setattr(np, "savetxt", fail)
    with pytest.raises((InputError, KeyboardInterrupt)):
        profile_csv.write(path, np.zeros(8))
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


# --- along the part

FEED, NOSE = 0.1e-3, 0.8e-3


def fed(offsets):
    """Revolutions with an offset each, and the heights of a steady feed."""
    turns = np.arange(len(offsets))[:, None] + np.arange(256) / 256
    return np.repeat(np.asarray(offsets, dtype=float)[:, None], 256, axis=1), FEED * turns


def test_nose_leaves_marks_of_f2_over_8r():
    """Without any error Rt = f²/(8r), and Ra = f²/(18·√3·r), that of a row of parabolas."""
    found = lay(*fed(np.zeros(12)), NOSE)
    assert (found.revolutions, found.surface.shape[0]) == (8, 64)
    assert found.feed == pytest.approx(FEED)
    assert found.errorless == pytest.approx(FEED**2 / (8 * NOSE), rel=2e-3)
    assert_allclose(found.rt, FEED**2 / (8 * NOSE), rtol=6e-3)
    assert_allclose(found.ra, FEED**2 / (18 * np.sqrt(3) * NOSE), rtol=0.02)


def test_deeper_revolution_stands_out_by_where_two_noses_meet():
    """Every second one deeper by δ: Rt = (f/2 + r·δ/f)²/(2r); beyond f²/2r the others cut nothing."""
    for deeper in (0.0, 0.5e-6, 3e-6):
        found = lay(*fed([-deeper * (k % 2) for k in range(8)]), NOSE)
        assert_allclose(found.rt, (FEED / 2 + NOSE * deeper / FEED) ** 2 / (2 * NOSE), rtol=0.02)
    alone = lay(*fed([-20e-6 * (k % 2) for k in range(8)]), NOSE)
    assert_allclose(alone.rt, (2 * FEED) ** 2 / (8 * NOSE), rtol=0.02)


def test_only_the_last_revolutions_that_were_fed_one_way_count():
    profile, height = fed(np.zeros(9))
    height[4:] -= 4 * FEED
    assert lay(profile, height, NOSE).revolutions == 5
    assert lay(profile, -height, NOSE).feed == pytest.approx(FEED)
    for still in (np.zeros_like(height), height[:2]):
        with pytest.raises(InputError, match="revolutions that were fed one way; allowed: 3 or more"):
            lay(profile[: still.shape[0]], still, NOSE)
    for radius, told in ((0.4 * FEED, "4e-05"), (0.5 * FEED, "5e-05")):
        with pytest.raises(InputError, match=rf"feed of 0\.0001 m/rev and a nose of {told} m; allowed: .* below twice"):
            lay(profile, height, radius)


def test_run_and_bag_tell_the_roughness_along_the_part(tmp_path):
    def measured(*options):
        return CliRunner().invoke(cli.main, ["measure", str(tmp_path / "bag"), *options]).output

    changes = ["spindle_encoder.revolutions=12.0", "tool.nose_radius=0.8e-3"]
    told = harness.run(config("piston", *changes), bag=tmp_path / "bag").summary()["along_um"]
    assert told["rt_errorless"] == pytest.approx(1e6 * FEED**2 / (8 * NOSE), rel=1e-3)
    assert told["rt_errorless"] < told["rt"] < 2 * told["rt_errorless"]
    assert json.loads(measured("--nose-radius", "0.8", "--json"))["along"] == pytest.approx(told)
    assert json.loads(measured("--json"))["along"] == pytest.approx(told)
    assert "last 8 revolutions at 100 µm/rev: Ra" in measured("--nose-radius", "0.8")
    short = harness.run(config("piston", "spindle_encoder.revolutions=2.0", changes[1]))
    assert "2 revolutions that were fed one way" in short.summary()["along_um"]
