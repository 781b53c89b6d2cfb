# SPDX-License-Identifier: Apache-2.0
"""Hysteresis: loops, inverses, rate independence; identification from loops, files and recordings."""

import itertools

import numpy as np
import pytest
from cells import cuts
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from machines import assert_refused, refusals
from machines import run as run_in_blocks
from numpy.testing import assert_allclose

from lathe_commission.hysteresis_fit import HysteresisLoop, from_signals, identify, of_measurement
from lathe_machine.plants.hysteresis import PROPORTIONAL, THRESHOLDS, WEIGHTS, BoucWen, PrandtlIshlinskii, plays
from lathe_papers.formulas.vibration import describing_function
from lathe_rc.signals.measurement_file import read

FORWARD = [PrandtlIshlinskii, BoucWen]
OPERATORS = [*FORWARD, lambda: PrandtlIshlinskii().inverse(), lambda: BoucWen().inverse()]
STROKE = 15e-6

paths = arrays(np.float64, st.integers(1, 60), elements=st.floats(-2.0, 2.0))


def run(operator, value, lengths=None):
    """Output of an operator for a whole path."""
    return run_in_blocks(lambda _, *parts: operator.block(*parts), 1, value, lengths=lengths)[0]


def between(path, pieces):
    """A path with more samples on each of its straight pieces, from rest on; and where its own samples are."""
    corners = np.append(0.0, path)
    parts = [np.linspace(a, b, pieces + 1)[1:] for a, b in itertools.pairwise(corners)]
    return np.concatenate(parts), np.arange(1, path.size + 1) * pieces - 1


def triangle(periods=3, points=4000, amplitude=1.0):
    """From 0 up, down and back, the last period of a steady loop in the last ``points`` samples."""
    phase = np.arange(1, periods * points + 1) / points
    return amplitude * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * phase))


@st.composite
def play_models(draw):
    """Prandtl-Ishlinskii operators with an inverse, also with negative weights."""
    n = draw(st.integers(0, 8))
    gaps = draw(st.lists(st.floats(0.01, 0.4), min_size=n, max_size=n))
    slopes = draw(st.lists(st.floats(0.2, 2.0), min_size=n + 1, max_size=n + 1))
    return PrandtlIshlinskii(np.cumsum(gaps), np.diff(slopes), slopes[0])


@st.composite
def bouc_wen_models(draw):
    """Bouc-Wen operators with an inverse."""
    beta = draw(st.floats(0.05, 3.0))
    gamma = beta * draw(st.floats(-0.9, 1.0))
    a = draw(st.floats(0.01, 0.9)) * (beta + gamma) / (2.0 * beta)
    return BoucWen(a, beta, gamma)


models = st.one_of(play_models(), bouc_wen_models())


# --- loops


@pytest.mark.parametrize("make", FORWARD)
def test_loop_is_13_percent_wide_and_ends_at_the_stroke(make):
    """spec/learning.md; width: largest distance of the branches over the height of the loop."""
    value = triangle()
    last = run(make(), value)[-4000:]
    # The period begins at 0 on its way up; sample k stands at (k + 1)/4000 of it.
    rising, falling = np.append(last[2999:], last[:1000]), last[999:3000]
    height = last.max() - last.min()
    assert np.abs(rising - falling[::-1]).max() / height == pytest.approx(0.13, abs=1e-3)
    assert_allclose([last.min(), last.max()], [-1.0, 1.0], atol=1e-4)


def test_play_follows_its_definition():
    """Paper-and-pencil positions of a play of 1."""
    path = np.array([0.5, 1.0, 3.0, 2.0, 1.0, 0.5, -4.0, -3.0, 0.0])
    expected = [0.0, 0.0, 2.0, 2.0, 2.0, 1.5, -3.0, -3.0, -1.0]
    assert_allclose(plays(np.ones(1), np.zeros(1), path)[:, 0], expected)
    assert_allclose(
        run(PrandtlIshlinskii(np.ones(1), np.array([0.5]), 2.0), path), 2.0 * path + 0.5 * np.array(expected)
    )


@given(paths)
def test_weights_add_up(path):
    positions = plays(THRESHOLDS, np.zeros(10), path)
    assert_allclose(run(PrandtlIshlinskii(), path), PROPORTIONAL * path + positions @ WEIGHTS, atol=1e-14)


@pytest.mark.parametrize("amplitude", [0.3, 0.7, 1.0, 1.6])
def test_first_harmonic_is_the_describing_function(amplitude):
    points = 20000
    value = amplitude * np.sin(2.0 * np.pi * np.arange(3 * points) / points)
    last = run(PrandtlIshlinskii(), value)[-points:]
    harmonic = 2j / points * (last * np.exp(-2j * np.pi * np.arange(points) / points)).sum()
    expected = describing_function(amplitude, THRESHOLDS, WEIGHTS, PROPORTIONAL)
    assert harmonic / amplitude == pytest.approx(expected, abs=1e-6)


@given(bouc_wen_models(), paths)
def test_bouc_wen_obeys_its_differential_equation(model, path):
    """dh = A·du - β·h·|du| - γ·|h|·du in steps of a thousandth of the path's own, by Heun's rule."""
    fine, own = between(path, 1000)
    h, before, followed = 0.0, 0.0, np.empty(fine.size)
    a, beta, gamma = model.a, model.beta, model.gamma
    for k, value in enumerate(fine):
        du = value - before
        slope = a * du - beta * h * abs(du) - gamma * abs(h) * du
        guess = h + slope
        h += (slope + a * du - beta * guess * abs(du) - gamma * abs(guess) * du) / 2.0
        before, followed[k] = value, h
    assert_allclose(run(model, path), model.gain * (path - followed[own]), atol=1e-4)


@given(bouc_wen_models())
def test_bouc_wen_ends_its_steady_loop_at_the_stroke(model):
    ends = run(model, np.tile([1.0, -1.0], 300))
    assert_allclose(ends[-2:], [1.0, -1.0], atol=1e-9)


@pytest.mark.parametrize("make", OPERATORS)
@given(paths, st.integers(1, 7), st.integers(1, 3))
def test_rate_changes_nothing(make, path, pieces, stays):
    """The same path in more samples, also with rests on the way, ends in the same places."""
    fine, own = between(path, pieces)
    assert_allclose(run(make(), np.repeat(fine, stays))[stays * own + stays - 1], run(make(), path), atol=1e-13)


@pytest.mark.parametrize("make", OPERATORS)
@given(cuts)
def test_cuts_change_nothing(make, lengths):
    value = np.random.default_rng(1).normal(size=sum(lengths))
    assert np.array_equal(run(make(), value, lengths), run(make(), value))


# --- inverses


@given(models, paths, paths)
def test_inverse_linearises_and_undoes_from_the_state_that_it_finds(model, before, path):
    run(model, before)
    inverse = model.inverse()
    assert_allclose(run(model, run(inverse, path)), path, atol=1e-12)
    assert_allclose(run(inverse, run(model, before)), before, atol=1e-12)


@given(models, paths)
def test_no_slope_is_steeper_than_told(model, path):
    fine, _ = between(path, 20)
    for operator in (model, model.inverse()):
        rise = np.abs(np.diff(run(operator, fine)))
        assert np.all(rise <= operator.steepest * np.abs(np.diff(fine)) + 1e-12)


def test_weights_15_percent_low_leave_2_percent():
    """spec/learning.md: RMS over the half-stroke, for a sine over the whole stroke from an amplifier that saturates."""
    model = PrandtlIshlinskii()
    value = np.sin(2.0 * np.pi * np.arange(30_000) / 10_000)
    for scale, left in ((0.85, 0.02), (1.0, 0.0)):
        inverse = PrandtlIshlinskii().identified(scale).inverse()
        error = (run(PrandtlIshlinskii(), np.clip(run(inverse, value), -1.0, 1.0)) - value)[-10_000:]
        assert np.sqrt(np.mean(error**2)) == pytest.approx(left, abs=2e-4)
    assert np.std(run(model, value) - value) > 0.07


@refusals(
    (lambda: PrandtlIshlinskii(np.ones(2), np.ones(3)), "2 thresholds and 3 weights"),
    (lambda: PrandtlIshlinskii(np.array([0.2, 0.2]), np.ones(2)), r"\[0.2, 0.2\]; allowed: above 0 and increasing"),
    (lambda: PrandtlIshlinskii(np.array([0.0, 0.2]), np.ones(2)), "above 0 and increasing"),
    (lambda: PrandtlIshlinskii(np.array([0.1, np.nan]), np.ones(2)), "above 0 and increasing"),
    (lambda: PrandtlIshlinskii(np.array([0.1, np.inf]), np.ones(2)), "above 0 and increasing"),
    (lambda: PrandtlIshlinskii(np.array([0.1]), np.ones(1), 0.0), "slope 0 after 0 plays"),
    (lambda: PrandtlIshlinskii(np.array([0.1, 0.2]), np.array([-0.5, 1.0]), 0.4), "slope -0.1 after 1 plays"),
    (lambda: PrandtlIshlinskii(np.array([0.1]), np.array([np.nan])), "allowed: above 0 for p0"),
    (lambda: BoucWen(a=0.0), "A = 0, β = 0.7, γ = 0.3; allowed: A > 0"),
    (lambda: BoucWen(gamma=0.8), "γ = 0.8; allowed: .* -β < γ <= β"),
    (lambda: BoucWen(a=np.nan), "allowed"),
    (lambda: BoucWen(a=0.72), r"2Aβ/\(β \+ γ\) = 1.008; allowed: below 1"),
)
def test_operator_without_an_inverse_is_refused(make, message):
    assert_refused(make, message)


# --- identification


def measured(model=None, amplitude=1.0, first=0, noise=0.0):
    """A loop of a drive, some periods of a sine from sample ``first`` on, its displacement 3 µm off."""
    value = amplitude * np.sin(2.0 * np.pi * np.arange(9000) / 3000)
    result = run(model or PrandtlIshlinskii(), value) + noise * np.random.default_rng(3).normal(size=value.size)
    return HysteresisLoop(value[first:] * STROKE, result[first:] * STROKE + 3e-6)


def test_drive_that_only_pushes_is_identified_from_rest():
    thresholds = THRESHOLDS[:4]
    command = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(9000) / 3000)
    response = run(PrandtlIshlinskii(thresholds, WEIGHTS[:4]), command)
    found = identify(HysteresisLoop(command * STROKE, response * STROKE), STROKE, thresholds)
    assert_allclose(found.model.weights, WEIGHTS[:4], atol=1e-10)


@given(
    st.lists(st.floats(0.0, 0.3), min_size=10, max_size=10),
    st.floats(0.3, 2.0),
    st.sampled_from([0, 500, 1700, 3100, 5000]),
)
def test_any_weights_are_found_wherever_the_record_begins(weights, proportional, first):
    found = identify(measured(PrandtlIshlinskii(THRESHOLDS, np.array(weights), proportional), first=first), STROKE)
    assert_allclose(found.model.weights, weights, atol=1e-8)
    assert (found.model.proportional, found.offset) == pytest.approx((proportional, 3e-6), abs=1e-8)
    assert found.residual < 1e-8


def test_noise_is_what_is_left_of_a_noisy_loop():
    found = identify(measured(noise=1e-3), STROKE)
    assert found.residual == pytest.approx(1e-3 / np.sqrt(0.5), rel=0.05)
    assert_allclose(found.model.weights, WEIGHTS, atol=3e-3)


def test_plays_come_near_another_hysteresis():
    """Ten plays make the steady Bouc-Wen loop to half a per cent, and linearise it to as much."""
    found = identify(measured(BoucWen(), first=3000), STROKE)
    assert found.residual < 0.005
    value = np.sin(2.0 * np.pi * np.arange(9000) / 3000)
    left = (run(BoucWen(), run(found.model.inverse(), value)) - value)[-3000:]
    assert left.std() < 0.01


def test_weights_are_not_negative():
    """A loop that goes round the other way has no such model: what is left says so."""
    loop = measured()
    found = identify(HysteresisLoop(loop.command, 2.0 * loop.command - loop.displacement), STROKE)
    assert np.all(found.model.weights >= 0.0)
    assert found.residual > 0.05


def fitted(command, displacement, thresholds=THRESHOLDS):
    """An identification of a loop that is yet to be measured."""
    return lambda: identify(HysteresisLoop(np.asarray(command), np.asarray(displacement)), STROKE, thresholds)


WHOLE = measured()


@refusals(
    (fitted(np.ones(3), np.ones(2)), "3 commands and 2 displacements"),
    (fitted([], []), "at least one"),
    (fitted([1.0, np.nan], np.ones(2)), "not all numbers are finite"),
    (fitted(np.ones(2), [np.inf, 0.0]), "not all numbers are finite"),
    (fitted(np.zeros(100), np.zeros(100)), "through its range of 0 µm"),
    (fitted(np.linspace(0, STROKE, 100), np.zeros(100)), "of 15 µm and back again; record one and a half"),
    (fitted(WHOLE.command / 2, WHOLE.displacement), "range of 15 µm does not take a play of 8.182 µm to each side"),
    (fitted(WHOLE.command, -WHOLE.command), "does the displacement rise"),
    (fitted(WHOLE.command[::450], WHOLE.displacement[::450]), "do not determine 12 unk"),
    (fitted(WHOLE.command, WHOLE.displacement, np.array([0.3, 0.2])), "above 0 and increasing"),
)
def test_loop_that_says_nothing_is_refused(make, message):
    assert_refused(make, message)


# --- files and recordings

HEAD = "command_um,displacement_um\n"


def write(tmp_path, text):
    path = tmp_path / "loop.csv"
    path.write_text(text)
    return path


def test_file_gives_the_loop(tmp_path):
    loop = measured()
    rows = "".join(f"{u:.17g},{y:.17g}\n" for u, y in np.stack((loop.command, loop.displacement), axis=1) * 1e6)
    back = of_measurement(read(write(tmp_path, "# piezo 7\n\n" + HEAD + rows)))
    assert_allclose(back.command, loop.command, atol=1e-18)
    assert_allclose(identify(back, STROKE).model.weights, WEIGHTS, atol=1e-9)


@pytest.mark.parametrize(("topics", "message"), [({}, "no topics"), ({"/fine/command": {}}, "there are /fine/command")])
def test_recording_without_the_drive_is_refused(topics, message):
    assert_refused(lambda: from_signals(topics), rf"is not in the recording; .*{message}")
