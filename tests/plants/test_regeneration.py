# SPDX-License-Identifier: Apache-2.0
"""Regeneration: the limit in formula, in the Nyquist plane and in the simulated cut."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_array_equal

from lathe_machine.analysis.regeneration import Regeneration, lobes
from lathe_machine.plants.cutting import GIVEN, MADE, CuttingProcess
from lathe_machine.plants.cutting_force import PAPER, REALISTIC, Elasticity, Flank, SpecificForce, flank_damping
from lathe_machine.transfer import TransferFunction

PRESETS = {"paper": (PAPER, 1e-3), "realistic": (REALISTIC, 5e-5)}  # and a step that resolves the mode [s]


def second_order(elasticity):
    """Stiffness k [N/m] and damping ζ."""
    pole = elasticity.transfer.poles[0]
    return 1 / elasticity.compliance, -pole.real / abs(pole)


@pytest.mark.parametrize(("name", "printed"), [("paper", 24), ("realistic", 469)])
def test_limits_of_the_spec(name, printed):
    """About 24 and 469 N/mm; the sign matters little in the first (23.60 drawn in, 23.82 pushed away)."""
    elasticity = PRESETS[name][0]
    limit = Regeneration(elasticity.transfer, elasticity.away).worst()
    assert limit.stiffness / 1e3 == pytest.approx(printed, abs=0.5)


@given(st.floats(1e-8, 1e-5), st.floats(1e-5, 1e-2), st.floats(0.004, 0.49), st.sampled_from([1, -1]))
def test_worst_speed_is_the_formula_of_a_spring_mass_damper(compliance, time, damping, sign):
    """2k·ζ·(1 ± ζ) at the frequency √(1 ± 2ζ)/time."""
    elasticity = Elasticity(compliance, time**2, 2 * damping * time, away=sign > 0)
    k, zeta = second_order(elasticity)
    limit = Regeneration(elasticity.transfer, elasticity.away).worst()
    assert limit.stiffness == pytest.approx(2 * k * zeta * (1 + sign * zeta), rel=1e-9)
    assert limit.frequency == pytest.approx(np.sqrt(1 + sign * 2 * zeta) / time, rel=1e-3)


@given(st.floats(0.01, 1.5), st.sampled_from(list(PRESETS)), st.sampled_from([0.3, 0.8, 1.0]))
def test_no_speed_is_worse_than_the_worst(relative_period, name, overlap):
    elasticity, _ = PRESETS[name]
    cutting = Regeneration(elasticity.transfer, elasticity.away, overlap)
    worst = cutting.worst()
    assert cutting.at(relative_period * worst.period(1)).stiffness >= worst.stiffness * (1 - 1e-9)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize(("overlap", "lag"), [(0.3, 0.0), (1.0, 0.0), (1.0, 0.075)])
def test_worst_speed_reaches_the_limit_with_a_pair_of_roots_on_the_axis(name, overlap, lag):
    elasticity, _ = PRESETS[name]
    transfer = elasticity.transfer * TransferFunction((1.0,), (lag, 1.0))
    cutting = Regeneration(transfer, elasticity.away, overlap)
    worst = cutting.worst()
    for waves in (0, 1, 3):
        period = worst.period(waves)
        at = cutting.at(period)
        assert at.stiffness == pytest.approx(worst.stiffness, rel=1e-6)
        assert at.frequency == pytest.approx(worst.frequency, rel=1e-3)
        root = cutting.root(worst.stiffness, period, 1j * worst.frequency)
        assert abs(root - 1j * worst.frequency) < 1e-6 * worst.frequency


def test_lobes_lie_on_the_limit_of_their_speed_or_above():
    cutting = Regeneration(REALISTIC.transfer)
    speed, stiffness = lobes(cutting, 1, np.linspace(345.0, 420.0, 12))
    assert_array_equal(np.sort(speed), speed)
    limits = np.array([cutting.at(2 * np.pi / rate).stiffness for rate in speed])
    assert np.all(limits <= stiffness * (1 + 1e-9))
    assert np.any(np.isclose(limits, stiffness, rtol=1e-9))
    nothing, _ = lobes(cutting, 1, np.array([100.0]))  # below the mode's frequency the surface only pushes back
    assert nothing.size == 0


def test_damped_spring_without_inertia_never_chatters():
    limit = Regeneration(TransferFunction((1e-7,), (1e-3, 1.0))).worst()
    assert limit.stiffness == np.inf


@given(st.floats(1e-8, 1e-5), st.floats(0.05, 0.95))
def test_edge_that_is_drawn_in_runs_away_without_swinging(compliance, overlap):
    """A lag alone: nothing rings. K·c·(1 - µ) = 1 at a fast spindle, K·c·(1 + µ) = 1 as it nearly stands."""
    cutting = Regeneration(TransferFunction((compliance,), (0.1, 1.0)), away=False, overlap=overlap)
    assert cutting.worst().stiffness == pytest.approx(1 / (compliance * (1 + overlap)))
    assert cutting.worst().period(3) == np.inf
    fast = cutting.at(1e-3)
    assert fast.frequency == 0.0
    assert fast.stiffness == pytest.approx(1 / (compliance * (1 - overlap)))
    assert abs(cutting.root(fast.stiffness, 1e-3, 1e-3)) < 1e-6


# --- the simulated cut


def deflection(name, stiffness, period, duration, kick, flank=Flank()):  # noqa: B008 - it never changes
    """Deflection [m] from a slow rise of the blank on, after which it kicks once; samples apart from then on."""
    elasticity, step = PRESETS[name]
    samples, engagement = round(duration / step), round(100 * 2 * np.pi * np.sqrt(elasticity.inertia) / step)
    speed = np.full(samples + engagement, 2 * np.pi / period)
    part = np.minimum(np.arange(speed.size) / engagement, 1.0)
    allowance = -1e-3 * (1 - part**3 * (10 - 15 * part + 6 * part**2))
    allowance[engagement : engagement + 20] = kick
    material = SpecificForce(kc1=stiffness / 1e-3)  # at 1 mm/rev
    process = CuttingProcess(
        material=material, depth=1e-3, lag=0.0, elasticity=elasticity, overlap=1.0, flank=flank, step=step
    )
    angle = speed * step * np.arange(speed.size)
    moving = {"angle": angle, "speed": speed, "feed_velocity": 1e-3 * speed / (2 * np.pi), "allowance": allowance}
    out = {key: np.empty_like(speed) for key in MADE}
    process.block(**dict.fromkeys(GIVEN, np.zeros_like(speed)) | moving | out)
    return out["deflection"][engagement:], np.sum(out["depth_of_cut"][engagement:] == 0.0)


def growth(signal, step):
    """Mean growth [1/s] over the last two thirds: half of them against the other."""
    third = signal.size // 3
    return float(np.log(np.std(signal[2 * third :]) / np.std(signal[third : 2 * third])) / (third * step))


@pytest.mark.parametrize("factor", [0.97, 1.03])
@pytest.mark.parametrize("name", PRESETS)
def test_cut_is_stable_just_below_the_limit_and_unstable_just_above(name, factor):
    """At the worst speed; what a kick changes grows as the characteristic root says."""
    elasticity, step = PRESETS[name]
    cutting = Regeneration(elasticity.transfer, elasticity.away)
    worst = cutting.worst()
    period, stiffness = worst.period(1), factor * worst.stiffness
    root = cutting.root(stiffness, period, 1j * worst.frequency)
    runs = [deflection(name, stiffness, period, 2.5 / abs(root.real), kick) for kick in (1e-7, 0.0)]
    assert [apart for _, apart in runs] == [0, 0]
    assert np.sign(root.real) == np.sign(factor - 1.0)
    assert growth(runs[0][0] - runs[1][0], step) == pytest.approx(root.real, rel=0.03)


@pytest.mark.parametrize("name", PRESETS)
def test_process_damping_raises_the_limit_as_a_damper_of_the_mode_does(name):
    """A flank of damping C is W3 with b + c·C: where the growth changes its sign is that one's limit."""
    elasticity, step = PRESETS[name]
    plain = Regeneration(elasticity.transfer, elasticity.away).worst()
    period = plain.period(1)
    flank = Flank(pressure=4e13, width=0.2e-3, land=0.1e-3)
    asked = elasticity.damping / elasticity.compliance / flank_damping(flank, 0.05 * 2 * np.pi / period, 0.0)
    damped = elasticity._replace(damping=2 * elasticity.damping)
    cutting = Regeneration(damped.transfer, damped.away)
    limit, found = cutting.at(period), []
    assert limit.stiffness > 1.5 * plain.stiffness
    for factor in (0.97, 1.03):
        stiffness = factor * limit.stiffness
        duration = 2.5 / abs(cutting.root(stiffness, period, 1j * limit.frequency).real)
        ran = flank._replace(pressure=asked * flank.pressure)
        kicked, still = (deflection(name, stiffness, period, duration, kick, ran)[0] for kick in (1e-7, 0.0))
        found.append(growth(kicked - still, step))
    assert found[0] < 0.0 < found[1]
    assert 0.97 + 0.06 * found[0] / (found[0] - found[1]) == pytest.approx(1.0, abs=4e-3)


def test_loss_of_contact_bounds_the_chatter():
    worst = Regeneration(REALISTIC.transfer).worst()
    signal, apart = deflection("realistic", 1.3 * worst.stiffness, worst.period(1), 20.0, 1e-6)
    quarters = np.abs(signal).reshape(4, -1).max(axis=1)
    assert apart > 1000
    assert quarters[3] == pytest.approx(quarters[2], rel=0.02)
    assert quarters[3] < 5e-3


@refusals(
    (lambda: Regeneration(PAPER.transfer, overlap=0.0), "regeneration: overlap 0; allowed: above 0, up to 1"),
    (lambda: Regeneration(TransferFunction((1.0,), (1.0, 0.0))), "allowed: stable"),
    (lambda: Regeneration(TransferFunction((1.0,), (1.0,))), "with inertia or lag"),
    (lambda: Regeneration(PAPER.transfer).at(0.0), "revolution of 0 s; allowed: above 0"),
)
def test_what_cannot_be_is_refused(make, message):
    assert_refused(make, message)
