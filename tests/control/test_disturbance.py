# SPDX-License-Identifier: Apache-2.0
"""The law that holds when speed, force and drive vary, its parts, and the laws it is compared with."""

from typing import NamedTuple

import numpy as np
import pytest
from cells import config, scenario
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.control import disturbance_memory
from lathe_machine.control.angle_filter import angle_filter, at, follow
from lathe_machine.signals.encoder import Encoder
from lathe_machine.signals.profile import Piston
from lathe_machine.signals.profile_table import derivatives_at, deviation_along, height_along, tabulated
from lathe_machine.stages.learning.law import Law
from lathe_rc import messages
from lathe_rc.cell import batch
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.wiring import Cell
from lathe_rc.cli import main
from lathe_rc.errors import DivergedError, InputError
from lathe_rc.signals import speed
from lathe_rc.study import STUDIES

STEP = 1 / 64000
NOMINAL = 1000 * np.pi / 30
TURN = 2 * np.pi
DELAY = 0.36e-3


def results(made):
    """Recordings of encoder and tool, and the controllers as they are at the end."""
    found = []
    for outcome in batch.run_many(made, ["encoder", "tool"], threads=1):
        assert outcome.error is None, outcome.error
        found.append((outcome.kept.of_type(messages.ENCODER), outcome.kept.of_type(messages.TOOL)))
    return found


def largest(found, since=0.0, gaps=()):
    """Largest error [µm] from a revolution on, where there is material."""
    encoder, tool = found
    angle, error = encoder["angle_true"], np.abs(tool["error"]) * 1e6
    counts = angle >= TURN * since
    for start, width in gaps:
        counts &= np.mod(angle - start, TURN) >= width
    return float(error[counts].max())


# --- the angle filter


def tracked(law, counts, samples, clock=0.0):
    """Angle and speed as measured, true angle, and what the filter says of the end of the drive's delay."""
    angle, rate, true, told, told_rate, unused = np.empty((6, samples))
    encoder = Encoder(law, STEP, counts, 64, edge_clock=clock)
    encoder.block(0, angle, rate, np.empty(samples, np.uint8), true, unused)
    spindle = angle_filter(STEP, counts, NOMINAL, 0.1, 300.0, clock)
    for k in range(samples):
        follow(spindle, angle[k])
        told[k], told_rate[k], _ = at(spindle, DELAY)
    return (angle, rate), true, (told, told_rate)


@pytest.mark.parametrize(
    ("counts", "frequency"), [(0, 213.0), (1000, 30.0), (1000, 213.0), (5000, 106.0), (10**5, 213.0)]
)
def test_filter_foretells_the_spindle_better_than_angle_and_speed_as_measured(counts, frequency):
    """Over the delay of a drive; ten times better where the encoder resolves a sample, twice where it does not."""
    law = speed.harmonic(NOMINAL, np.array([0.1]), np.array([frequency]), np.zeros(1), 0.1)
    (angle, rate), _, told = tracked(law, counts, 24_000)
    ahead = law.at(np.arange(24_000) * STEP + DELAY)
    for found, plain, truth in zip(told, (angle + DELAY * rate, rate), ahead[:2], strict=True):
        errors = [np.sqrt(np.mean((guess - truth)[12_000:] ** 2)) for guess in (found, plain)]
        assert errors[0] < errors[1] / (10 if counts in (0, 10**5) else 2)


def test_filter_without_a_deviation_finds_the_middle_of_the_counts():
    """The angle as measured is late by half a count; the filter is not."""
    (angle, _), true, (told, _) = tracked(speed.constant(NOMINAL), 1000, 20_000)
    late, off = (np.mean((found - true)[10_000:]) * 1000 / TURN for found in (angle, told - NOMINAL * DELAY))
    assert abs(off) < 0.03
    assert_allclose(late, -0.5, rtol=0.05)


@pytest.mark.parametrize("counts", [1000, 3500, 4096])
@pytest.mark.parametrize("frequency", [20.0, 300.0])
def test_edge_times_make_every_count_as_good_as_fifty_thousand(counts, frequency):
    law = speed.harmonic(NOMINAL, np.array([0.1]), np.array([frequency]), np.zeros(1), 0.1)
    ahead = law.at(np.arange(24_000) * STEP + DELAY)[0]
    timed, fine, plain = (
        np.abs(tracked(law, *encoder)[2][0] - ahead)[12_000:].max()
        for encoder in ((counts, 24_000, 1e-6), (50_000, 24_000), (counts, 24_000))
    )
    assert timed < 2.0 * fine
    assert timed < 0.5 * plain


# --- the form ahead


def test_derivatives_along_the_form_are_those_of_the_form():
    """Also across the rows of a part that changes with the height, and at the start of the next part."""
    form = tabulated(Piston(0.5e-3, 0.4e-3, 30e-6, 0.06, 0.02))
    feed, start, part = 0.4e-3, 0.01, 50
    angle = np.linspace(3.0, 330.0, 1501)
    h = 1e-4
    values = []
    for offset in (-h, 0.0, h):
        height, value = np.empty((2, angle.size))
        height_along(feed, start, part, angle + offset, height)
        deviation_along(form.heights, form.table, angle + offset, height, value)
        values.append(value)
    found = np.array([derivatives_at(form.heights, form.table, feed, start, part, a) for a in angle]).T
    inside = np.mod(angle, part * TURN) > 0.1
    assert_allclose(found[0], values[1], atol=1e-15)
    assert_allclose(found[1][inside], ((values[2] - values[0]) / (2 * h))[inside], atol=2e-9)
    assert_allclose(found[2][inside], ((values[2] - 2 * values[1] + values[0]) / h**2)[inside], atol=5e-6)


# --- what the law knows of its cell


def test_form_and_encoder_are_given_once_with_tool_and_spindle():
    cell = config("robust", "tool.harmonic_order=[3]", "spindle_encoder.counts_per_revolution=5000")
    law = cell.nodes["disturbance_controller"]
    assert (law.harmonic_order, law.harmonic_amplitude, law.encoder_counts) == ([3], [225e-6], 5000)
    cell = config("robust", "disturbance_controller.encoder_counts=0", "disturbance_controller.profile=piston")
    law = cell.nodes["disturbance_controller"]
    assert (law.encoder_counts, law.profile, law.harmonic_order) == (0, "piston", [])


def test_two_forms_in_a_cell_are_not_guessed_between():
    values = {"stage": "tool", "profile": "piston", "remap": ["tool:=other"]}
    made = scenario(disturbance_controller={"feedback_delay": 64}, second=values)
    assert made.nodes["disturbance_controller"].profile == "harmonics"  # not loaded, so not resolved
    with pytest.raises(InputError, match=r"disturbance_controller\.\w+ is not given, and tool and second differ in it"):
        made.varied({"tool.feed": 1e-4})


# --- the law


@pytest.mark.parametrize(("counts", "noise"), [(0, 0.0), (1000, 0.0), (3000, 200.0), (10**5, 20.0), (10**6, 200.0)])
def test_it_is_less_than_half_as_wrong_as_the_variable_lead_where_no_counts_are_warned_of(counts, noise):
    """Slow and fast deviations, harmonics 2 and 5; it begins with a model that is 20 % wrong."""
    common = {
        "spindle_encoder.revolutions": 58.0, "spindle_encoder.counts_per_revolution": counts,
        "electrodynamic_actuator.noise_rms": noise * 1e-9, "tool.harmonic_amplitude": [225e-6],
    }  # fmt: skip
    made = [
        config(name).varied({**common, "spindle_encoder.deviation_frequency": [wd], "tool.harmonic_order": [harmonic]})
        for name in ("speed_deviation", "robust")
        for wd, harmonic in ((20.0, 2), (300.0, 2), (60.0, 5))
    ]
    errors = [largest(found, since=50.0) for found in results(made)]
    assert np.all(np.array(errors[3:]) <= 0.5 * np.array(errors[:3])), errors


GAPS = [(0.5, 0.35), (2.6, 0.35), (4.7, 0.35)]


def drive(frequency, damping, stiffness, delay):
    """Changes of the cell of robust_cutting.yaml; the law is told the nominal drive."""
    return {
        "loaded_drive.coarse_natural_frequency": 1038.0 * frequency,
        "loaded_drive.coarse_damping": 0.804 * damping,
        "loaded_drive.coarse_delay": DELAY * delay,
        "loaded_drive.coarse_moving_mass": 1.2 * stiffness / frequency**2,
        "controller.model_natural_frequency": 1038.0,
        "controller.model_damping": 0.804,
        "controller.model_delay": DELAY,
        "spindle_encoder.revolutions": 30.0,
    }


def test_everything_at_once_leaves_less_than_a_micrometre_whatever_the_drive():
    """Speed, keyways, run-out, hard spot and wear; drives at opposite corners of ±20 %, an encoder, a noisy sensor."""
    corners = [(1.0, 1.0, 1.0, 1.0), (0.8, 0.8, 1.2, 1.2), (1.2, 1.2, 0.8, 0.8), (0.8, 1.2, 0.8, 1.2)]
    cut = config("robust_cutting", "controller.allow_unstable=true")
    for corner, found in zip(corners, results([cut.varied(drive(*corner)) for corner in corners]), strict=True):
        assert largest(found, gaps=GAPS) > 10.0, corner  # in the first revolution
        assert largest(found, since=20.0, gaps=GAPS) < 1.0, corner


RANDOM = {"loaded_drive.cut_allowance_rms": 20e-6, "loaded_drive.cut_allowance_time": 0.05}


@pytest.mark.parametrize(
    ("without", "condition", "times"),
    [("learning_gain=0.0", {}, 5.0), ("observer_bandwidth=0.0", RANDOM, 2.0), ("follows_speed=false", {}, 1.3)],
)
def test_each_part_of_it_earns_its_place(without, condition, times):
    """The observer where the blank is random."""
    values = {**drive(1.0, 1.0, 1.0, 1.0), **condition}
    made = [config("robust_cutting", *change).varied(values) for change in ([], [f"controller.{without}"])]
    whole, less = (largest(found, 20.0, GAPS) for found in results(made))
    assert less > times * whole


def test_the_drive_is_identified_while_it_cuts():
    """With a varying speed the drive is identified under the force to 3 % after 20 revolutions."""
    made = config("robust_cutting", "controller.allow_unstable=true").varied(drive(0.8, 1.2, 1.0, 1.0))
    cell = Cell(made.nodes)
    keeper = batch.Errors(cell, cell.samples)
    Engine(cell, keeper.heard).run([keeper])
    a1, a2 = cell.stages["controller"].law.known.model
    assert_allclose([a1, a2], [2 * 0.804 * 1.2 / (0.8 * 1038.0), 1 / (0.8 * 1038.0) ** 2], rtol=0.03)


def test_a_jump_of_the_angle_is_not_measured_point_by_point():
    """Its error ends the run, as soon as that of a small jump does."""
    fault = "spindle_encoder.faults=['revolution 2: encoder.angle wrong offset=1e8']"
    jumps = config("robust", "allow_faults=true", "spindle_encoder.revolutions=6", fault)
    (outcome,) = batch.run_many([jumps], ["tool"], threads=1)
    assert isinstance(outcome.error, DivergedError)


def test_frozen_it_keeps_what_it_has_learned_and_clear_forgets_that():
    events = '["revolution 12: freeze", "revolution 18: clear"]'
    cut = config("robust_cutting", f"controller.events={events}").varied(drive(1.0, 1.0, 1.0, 1.0))
    ((encoder, tool),) = results([cut.varied({"spindle_encoder.revolutions": 22.0})])
    error = np.abs(tool["error"]) * 1e6
    revolution = encoder["angle_true"] / TURN
    assert error[(revolution > 13) & (revolution < 17)].max() < 2.0
    assert error[revolution > 18.5].max() > 5.0


def test_what_is_refused_does_diverge():
    """A model whose drive is three times faster: the observer's own loop grows."""
    wrong = {**drive(3.0, 1.0, 1.0, 1.0), "controller.identify": False, "controller.learning_gain": 0.0}
    with pytest.raises(InputError, match=r"diverges with loaded_drive: sup\|factor of a revolution\| = "):
        Cell(config("robust_cutting").varied(wrong).nodes).check()
    grown = config("robust_cutting", "controller.allow_unstable=true").varied({**wrong, "controller.stop_ratio": 2.0})
    (outcome,) = batch.run_many([grown], batch.Errors)
    assert "the error grows" in str(outcome.error)


def test_smoothing_passes_what_is_learned_and_half_at_its_edge():
    taps = disturbance_memory.smoothing(60.0, 512)
    places = np.arange(taps.size) - taps.size // 2
    waves = np.array([0.0, 10.0, 60.0, 200.0])
    response = np.cos(TURN / 512 * np.outer(waves, places)) @ taps
    assert_allclose(response, [1.0, 1.0, 0.5, 0.0], atol=2e-3)
    with pytest.raises(InputError, match="waves per revolution: the filter is wider than a revolution"):
        disturbance_memory.smoothing(2.0, 512)


# --- the laws it is compared with


@pytest.mark.parametrize(("stage", "below"), [("compound_controller", 0.5), ("resonant_controller", 0.05)])
def test_a_peer_answers_the_force(stage, below):
    """Of what feed-forward alone leaves of a cut with three keyways; `lathe study robust` has the figures."""
    steady = drive(1.0, 1.0, 1.0, 1.0) | {"spindle_encoder.random_rms": 0.0}
    blind = {"learning_gain": 0.0, "observer_bandwidth": 0.0, "identify": "false"}
    alone = config("robust_cutting", *(f"controller.{name}={value}" for name, value in blind.items())).varied(steady)
    whole = [f"controller.stage={stage}", "controller.stop_ratio=0.0", "controller.allow_unstable=true"]
    peer = config("robust_cutting", *whole)
    error = [largest(found, 20.0, GAPS) for found in results([alone, peer.varied(steady)])]
    assert error[1] < below * error[0]


# --- laws of others


class Seen(NamedTuple):
    positions: list


class Sensing(Law):
    """Tells what it senses."""

    kind = "sensing"
    senses = True

    @staticmethod
    def sample(memory, now):
        memory.positions.append(now.position)
        return 1e-6 * np.sin(209.0 * now.time)

    def start(self):
        return Seen([])


def test_a_law_that_senses_gets_the_measured_position():
    table = Sensing.Parameters.read("law", {"feedback_delay": 64, "block_size": 64})
    law = Sensing("law", table)
    assert [(port.topic, port.fields, port.delay) for port in law.inputs][-1] == (
        "coarse/state", ("measured_position",), 64,
    )  # fmt: skip
    fields = np.random.default_rng(0).standard_normal((6, 64))
    law.step(law.memory, 0, 0, tuple(fields), (np.zeros(64, np.uint8),), (np.empty(64),))
    assert_array_equal(law.law.positions, fields[-1])


# --- the studies that judge it


@pytest.mark.system
def test_the_suite_has_it_within_the_tolerance_and_ahead_of_its_peer_with_everything_at_once():
    study = STUDIES["robust"]
    found = study.run(study.parameters(plants=1, revolutions=24, conditions=["all at once"])).to_json()
    assert list(found) == [
        "conditions", "laws", "seeds", "tolerance_um", "largest_um", "rms_um", "revolutions", "effort_a", "margin",
    ]  # fmt: skip
    for plant in ("told", "worst"):
        (errors,) = found["largest_um"][plant]
        of = dict(zip(found["laws"], errors, strict=True))
        assert of["ours"] == min(errors)
        assert of["ours"] < 1.0 < min(of["told"], of["comp."])
        assert found["revolutions"][plant][0][found["laws"].index("ours")] < 12


def test_the_map_compares_each_sensor_with_the_variable_lead():
    study = STUDIES["sensor-map"]
    given = study.parameters(counts=[4096], edge_clock_us=[0.0, 1.0], wd=[20.0, 213.0], harmonics=[2], seeds=[1])
    result = study.run(given)
    assert result.ratio.shape == (1, 2, 1, 1, 2)
    assert result.warned.tolist() == [[True, False]]
    found = result.to_json()
    assert found["worst_ratio"] == result.ratio.max() > 0.8
    assert found["worst_ratio_unwarned"] == result.ratio[0, 1].max() < 0.3
    assert 0.0 < found["floor_um"][0][0][0][0] < found["variable_lead_um"][0][0][0][0][0]


def test_a_study_that_has_a_quick_form_has_an_option_for_it():
    assert "--quick" in CliRunner().invoke(main, ["study", "robust", "--help"]).stdout
