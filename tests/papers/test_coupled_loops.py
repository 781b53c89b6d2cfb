# SPDX-License-Identifier: Apache-2.0
"""The coupled loops of paper 004: poles against the spec and against hand-made systems, the simulation against both."""

from dataclasses import replace
from itertools import product

import control
import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.analysis.pid_tuning import response
from lathe_machine.control.decoupler import LEAK, PAPER, Channels, gain
from lathe_machine.control.pid import FORCE, POSITION
from lathe_papers.formulas.coupled_loops import CONNECTIONS, loops, with_errors
from lathe_papers.formulas.coupled_simulation import STEP, CoupledSimulation
from lathe_rc.errors import InputError

FREQUENCY = np.geomspace(0.1, 300.0, 40)
both_plants = pytest.mark.parametrize("force_plant", ["approximate", "full"])


def simulate(system, samples, *, force=0.0, position=0.0, noise=None, lengths=None, step=STEP, **options):
    """The simulation, and F, y, v1, v2 as rows."""
    simulation = CoupledSimulation(system, step, **options)
    inputs = (np.full(samples, force), np.full(samples, position), np.zeros(samples) if noise is None else noise)
    out = np.empty((4, samples))
    in_blocks(lengths or [samples], simulation.block, *inputs, *out)
    return simulation, out


# --- poles


@both_plants
def test_paper_preset_is_stable_as_the_spec_says(force_plant):
    """Without K1 the loops oscillate and grow, slowly; with it they do not."""
    growth = {name: loops("paper", force_plant, name).growth() for name in CONNECTIONS}
    assert 0.1 < growth["none"] < 0.24
    assert 0.1 < growth["k2"] < 0.24
    assert max(growth["k1"], growth["both"]) < 0.0


@both_plants
def test_realistic_preset_is_stable_either_way(force_plant):
    for name, wait in product(CONNECTIONS, (0.0, 1e-3)):
        assert loops("realistic", force_plant, name, wait).growth() < 0.0


@both_plants
@pytest.mark.parametrize("preset", ["paper", "realistic"])
def test_errors_of_half_the_plant_leave_both_compensators_stable(preset, force_plant):
    growth = [system.growth() for _, system in with_errors(loops(preset, force_plant))]
    assert len(growth) == 10
    assert max(growth) < 0.0


def test_errors_change_the_plant_and_not_the_compensators():
    known = loops()
    off = dict(with_errors(known))["w3_frequency x 0.5"]
    assert (off.k1, off.k2) == (known.k1, known.k2)
    assert np.abs(off.channels.w3.poles) == pytest.approx(0.5 * np.abs(known.channels.w3.poles))
    assert off.channels.w3.response(0.0) == pytest.approx(known.channels.w3.response(0.0))


def test_closed_loop_answers_as_the_equations_say():
    """(I + G·C)⁻¹·G·C from the responses of the parts, at every frequency."""
    for preset in ("paper", "realistic"):
        system = loops(preset, "full", "both", 1e-3)
        w1, w2, w3, w4, k1, k2, c1, c2 = (
            part.response(FREQUENCY)
            for part in (
                system.channels.w1, system.channels.w2, system.channels.w3, system.channels.w4, system.k1, system.k2,
                FORCE.transfer, POSITION.transfer,
            )
        )  # fmt: skip
        found = response(system.system(), FREQUENCY)
        late = np.exp(-1e-3j * FREQUENCY)
        for k in range(FREQUENCY.size):
            drives = np.array([[w1[k], w4[k] * w2[k]], [w3[k] * w1[k], (1 + w3[k] * w4[k]) * w2[k]]])
            together = drives @ np.array([[1, -k1[k]], [-k2[k], 1]]) @ np.diag([c1[k], c2[k]])
            noise = np.array([1.0, w3[k]])
            inverse = np.linalg.inv(np.eye(2) + together * late[k])
            assert_allclose(found[:2, :2, k], inverse @ together, rtol=1e-5, atol=1e-12)
            assert_allclose(found[:2, 2, k], inverse @ noise, rtol=1e-4, atol=1e-10)


def test_leak_is_the_slow_pole():
    assert np.abs(loops().poles()).min() == pytest.approx(LEAK, rel=0.2)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("ideal",), "preset 'ideal'; allowed: paper, realistic"),
        (("paper", "fuller"), "force plant 'fuller'; allowed: approximate, full"),
        (("paper", "full", "k3"), "connection 'k3'; allowed: none, k1, k2, both"),
    ],
)
def test_unknown_names_are_refused(names, message):
    with pytest.raises(InputError, match=message):
        loops(*names)


# --- simulation


@pytest.mark.parametrize("connection", CONNECTIONS)
def test_simulation_without_limits_is_the_linear_system(connection):
    system = loops("realistic", "full", connection)
    samples, step = 20_000, 1e-5
    inputs = np.array([[10.0], [10e-6], [3.0]]) * np.ones(samples)
    expected = control.forced_response(system.system(), np.arange(samples) * step, inputs).outputs[:2]
    _, found = simulate(
        system, samples, force=10.0, position=10e-6, noise=np.full(samples, 3.0), step=step, limit=np.inf
    )
    for row in range(2):
        # The controllers see the first sample as the end of a rise from the sample before.
        assert_allclose(found[row], expected[row], atol=4e-3 * np.abs(expected[row]).max())


def test_growth_is_that_of_the_poles():
    """Small oscillations of the paper's loops without compensators grow as their poles say."""
    system = loops("paper", "approximate", "none")
    _, out = simulate(system, 240_000, force=1e-3)
    swing = [np.ptp(out[0][start : start + 10_000]) for start in (100_000, 220_000)]
    assert np.log(swing[1] / swing[0]) / 6.0 == pytest.approx(system.growth(), rel=0.02)


@both_plants
def test_compensators_cut_the_cross_coupling(force_plant):
    """Realistic preset: several-fold with the plant that the compensators are made for."""
    peaks = {}
    for name in ("none", "both"):
        system = loops("realistic", force_plant, name)
        force = np.abs(simulate(system, 20_000, position=10e-6)[1][0]).max()
        position = np.abs(simulate(system, 20_000, force=10.0)[1][1]).max()
        peaks[name] = np.array([force, position])
    least = {"approximate": [30.0, 5.0], "full": [2.5, 1.5]}[force_plant]
    assert np.all(peaks["none"] / peaks["both"] > least)


def test_delay_is_of_whole_samples():
    system = loops("realistic", "approximate", "both", 1e-3)
    prompt = simulate(replace(system, wait=0.0), 200, force=1.0)[1]
    late = simulate(system, 200, force=1.0)[1]
    assert np.array_equal(late[:, :20], simulate(replace(system, force=FORCE), 20, force=1.0)[1])
    # Until the first measurement that is not 0 comes back, the controllers do not see their own effect.
    assert not np.array_equal(late[:, :200], prompt)
    unseen = CoupledSimulation(replace(system, wait=64 / 64000), 1 / 64000)
    assert unseen._table.delay == 64
    with pytest.raises(InputError, match=r"delay 0\.00011 s is 2\.2 samples of 5e-05 s; allowed: a whole"):
        CoupledSimulation(replace(system, wait=1.1e-4))


def test_limits_hold_and_are_counted():
    simulation, out = simulate(loops("realistic"), 4000, force=150.0, position=1e-3)
    assert np.abs(out[2:]).max() == 1.0
    assert simulation.force_pid.saturated > 0
    assert simulation.position_pid.saturated > 0
    assert simulation.cut > 0
    free, _ = simulate(loops("realistic"), 4000, force=150.0, position=1e-3, limit=np.inf)
    assert (free.cut, free.force_pid.saturated, free.position_pid.saturated) == (0, 0, 0)


def test_converters_leave_an_error_of_their_step():
    simulation, out = simulate(loops("realistic"), 100_000, force=150.0, position=1e-4, adc=(0.5, 1e-6), dac=1 / 2048)
    assert np.abs(out[0][-20_000:] - 150.0).max() < 2.0
    assert np.abs(out[1][-20_000:] - 1e-4).max() < 1e-5
    assert np.ptp(out[1][-20_000:]) > 1e-8
    assert simulation.force_pid.table.adc == 0.5


def test_smooth_entry_has_no_overshoot():
    system = loops("realistic", "full")
    step = simulate(system, 60_000, force=150.0)[1][0].max() / 150.0 - 1.0
    smooth = simulate(system, 60_000, force=150.0, ramp=300.0, smoothing=0.3)[1][0].max() / 150.0 - 1.0
    assert step > 0.05
    assert smooth < 2e-4


@settings(max_examples=15)
@given(cuts, st.sampled_from([0.0, 1e-3]), st.sampled_from(list(CONNECTIONS)))
def test_cuts_change_nothing(lengths, wait, connection):
    samples = sum(lengths)
    noise = np.random.default_rng(1).normal(size=samples)
    options = {"force": 20.0, "position": 1e-5, "noise": noise, "adc": (0.1, 1e-7), "dac": 1e-3}
    system = loops("realistic", "full", connection, wait)
    whole, expected = simulate(system, samples, **options)
    cut, found = simulate(system, samples, lengths=lengths, **options)
    assert np.array_equal(found, expected)
    assert cut.cut == whole.cut


def test_plant_that_answers_at_once_is_refused():
    with pytest.raises(InputError, match="acts on a measurement at once"):
        CoupledSimulation(replace(loops(connection="none"), channels=Channels(gain(5.0), PAPER.w2, PAPER.w3, PAPER.w4)))
