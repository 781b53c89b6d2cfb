# SPDX-License-Identifier: Apache-2.0
"""Refusals and warnings before a start name values that are in fact allowed."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from machines import line_of

from lathe_commission.reduced_order import ChannelStep, fit_inverse
from lathe_machine.stages.learning.learner import Learner
from lathe_machine.transfer import TransferFunction
from lathe_rc import harness, resources
from lathe_rc.cell import batch
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import at_least, at_most

CONFIG = Path(__file__).parents[2] / "config"
FAST = ("nominal_rpm=3000.0",)
FIR = ("learning_controller.q_filter=fir",)
WAVES = "disturbance_controller.learned_waves=2.0"


def load(name, *changes):
    return scenarios.load(CONFIG / f"{name}.yaml", list(changes))


def refused(name, *changes):
    return line_of(lambda: Cell(load(name, *changes).nodes).check())


def cures(said):
    """The alternatives that a refusal names, each as overrides; a parameter without a node is of the refused node."""
    node = re.match(r"\w+", said)[0]
    for cure in re.split(r" or (?=\w+\.)", said.rpartition("allowed: ")[2]):
        found = re.findall(r"(?:(\w+)\.)?(\w+) = ([\d.e+-]*\d)", cure)
        if found:
            yield [f"{of or node}.{name}={float(value)!r}" for of, name, value in found]


DIVERGES = [
    ("robust_cutting", *FAST),
    ("piston", *FIR),
    ("piston", *FIR, *FAST, "learning_controller.feedback_delay=1000"),
    ("piston", "learning_controller.lead_time=0.0"),
    ("piston", "learning_controller.q_time=0.0", "learning_controller.q_filter=gaussian"),
    ("two_channel", "fine_controller.lead_time=0.0"),
    ("adaptive_inverse", "learning_controller.lead_time=2e-3"),
    ("lead_lag", "learning_controller.lead_time=0.1e-3"),
]
NO_ROOM = [
    ("piston", "learning_controller.q_time=0.1"),
    ("piston", "learning_controller.q_time=0.1", "learning_controller.q_filter=moving_average"),
    ("piston", *FIR, "learning_controller.q_stop=2350.0", "learning_controller.q_pass=2300.0"),
    ("piston", *FIR, "learning_controller.q_stop=90000.0", "learning_controller.q_pass=2300.0"),
    ("piston", *FIR, "learning_controller.q_stop=2000.0", "learning_controller.q_pass=2300.0"),
]


@pytest.mark.parametrize("given", DIVERGES, ids=" ".join)
def test_each_parameter_that_is_named_for_a_loop_that_diverges_lets_it_start(given):
    said = refused(*given)
    named = list(cures(said))
    assert named, said
    assert FIR[0] not in given or "q_time" not in said
    for changes in named:
        Cell(load(*given, *changes).nodes).check()


@pytest.mark.parametrize("given", NO_ROOM, ids=" ".join)
def test_q_filter_that_is_named_fits_into_the_memory(given):
    (changes,) = cures(refused(*given))
    Cell(load(*given, *changes).nodes)


def test_what_is_named_learns_where_what_was_refused_grows():
    """The form has harmonics near those that grow fastest."""
    form = ("tool.profile=harmonics", "tool.harmonic_order=[10]", "tool.harmonic_amplitude=[1e-6]")
    given = ("piston", "learning_controller.lead_time=0.0", *form)
    made = [
        load(*given, "spindle_encoder.revolutions=20", *changes)
        for changes in (["learning_controller.allow_unstable=true"], *cures(refused(*given)))
    ]
    grown, *learned = (outcome.kept.rms for outcome in batch.run_many(made, batch.Errors, threads=1))
    assert grown[-1] > 2.0 * grown[0]
    assert all(errors[-1] < 0.1 * errors[0] for errors in learned)


def test_where_the_model_alone_is_wrong_no_other_cure_is_named():
    said = refused("robust", "disturbance_controller.model_natural_frequency=400.0")
    assert said.endswith("allowed: below 1 (a model nearer to the drive; or set allow_unstable)")


@pytest.mark.parametrize("points", [64, 512, 4096])
def test_fewest_waves_that_a_memory_learns_are_allowed(points):
    grid = f"disturbance_controller.points_per_revolution={points}"
    least = int(re.search(r"allowed: (\d+) waves or more", refused("robust", WAVES, grid))[1])
    Cell(load("robust", grid, f"disturbance_controller.learned_waves={least}.0").nodes)
    refused("robust", grid, f"disturbance_controller.learned_waves={least - 1}.0")


@pytest.mark.parametrize(
    ("name", "node", "rpm"),
    [("piston", "learning_controller", 3000.0), ("robust", "disturbance_controller", 30000.0)],  # a block fits, or not
)
def test_feedback_delay_that_is_allowed_fits_into_the_cycle(name, node, rpm):
    """Where a block is longer than the allowed delay, the block size follows it."""
    said = refused(name, f"nominal_rpm={rpm}")
    assert "lead_time" not in said
    largest = int(re.search(r"(\d+)(?: or less|$)", said.rpartition("allowed: ")[2])[1])
    changes = [
        f"nominal_rpm={rpm}",
        "electrodynamic_actuator.max_acceleration=1e9",
        f"{node}.feedback_delay={largest}",
        f"block_size={min(largest, 64)}",
    ]
    cell = Cell(load(name, *changes, f"{node}.allow_unstable=true", "electrodynamic_actuator.max_velocity=1e3").nodes)
    cell.check()


# --- computed limits, which messages round


@given(st.floats(1e-12, 1e12), st.integers(2, 6))
def test_told_limits_are_allowed_themselves(limit, digits):
    assert limit * (1.0 - 10.0 ** (1 - digits)) <= float(at_most(limit, digits)) <= limit
    assert limit <= float(at_least(limit, digits)) <= limit * (1.0 + 10.0 ** (1 - digits))


POLYGON = "tool.profile=polygon tool.polygon_inscribed_radius=0.0123456789"
LINE = "vibration.line_amplitude=[1e-6] vibration.random_rms=0.0"


@pytest.mark.parametrize(
    ("name", "parameter", "beyond", "changes", "before"),
    [
        ("periodic", "position_controller.memory_filter", 10.0, "", "up to "),
        ("periodic", "position_controller.memory_filter", 9.0, "position_controller.period=7.777", "up to "),
        ("force_turning", "cutting_process.lag", 1e-12, "sample_rate=40000", "at least "),
        ("two_channel", "piezo_actuator.amplifier_lag", 1e-12, "sample_rate=40000", "at least "),
        ("piston", "tool.polygon_corner_radius", 0.5, POLYGON, "inscribed radius "),
        ("vibration", "vibration.line_frequency", [3e5], LINE, "below "),
    ],
)
def test_the_limit_that_is_named_is_allowed(name, parameter, beyond, changes, before):
    changes = changes.split()
    said = refused(name, *changes, f"{parameter}={beyond!r}")
    limit = float(re.search(rf"allowed: .*{before}([\d.e+-]*\d)", said)[1])
    value = [limit] if isinstance(beyond, list) else limit
    Cell(load(name, *changes, f"{parameter}={value!r}").nodes)


def test_the_lag_that_is_named_suits_the_record():
    time = np.arange(64) / 48_000  # a step that is no short number
    model, measured = TransferFunction((1.0,), (1e-4, 1.0)), ChannelStep(time, 1.0 - np.exp(-time / 1e-4))
    refusal = line_of(lambda: fit_inverse(model, measured, least_lag=1e-6))
    fit_inverse(model, measured, least_lag=float(re.search(r"--lag ([\d.e-]*\d)", refusal)[1]))


def test_revolutions_that_are_named_are_in_the_file(tmp_path):
    counts = tmp_path / "counts.csv"
    # 66.7606 revolutions, and a bit less
    rows = [f"{k * 1e-3:.3f},{round(4096 * k / 59.9 + 0.4)}" for k in range(4000)]
    counts.write_text("\n".join(["time_s,counts", *rows]), encoding="utf-8")
    file = tmp_path / "cell.yaml"
    file.write_text("/encoder_device: {ros__parameters: {source: file, counts_per_revolution: 4096}}", encoding="utf-8")

    def device(revolutions):
        changes = [f"encoder_device.revolutions={revolutions!r}", f"encoder_device.counts_file={counts}"]
        return Cell(scenarios.load(file, changes).nodes).master

    refusal = line_of(lambda: device(1000.0))
    device(float(re.search(r"after ([\d.]+) revolutions", refusal)[1]))


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        (("deviation_amplitude=[1.2]", "deviation_frequency=[1.0]"), "nominal_rpm and its deviations: spindle speed"),
        (("revolutions=1e15",), "revolutions = 1e+15, "),
    ],
)
def test_a_speed_that_falls_to_0_is_laid_to_its_deviations(changes, culprit):
    assert culprit in refused("speed_deviation", *(f"spindle_encoder.{change}" for change in changes))


def test_a_set_point_is_read_in_its_own_unit(tmp_path):
    """A position controller refuses a file of forces and names its own header, and vice versa."""
    for column in ("position_um", "force_n"):
        (tmp_path / f"{column}.csv").write_text(f"time_s,{column}\n0,1\n1,2\n", encoding="utf-8")
    for name, node, own, other in (
        ("approach", "position_controller", "position_um", "force_n"),
        ("force_turning", "force_controller", "force_n", "position_um"),
    ):
        given = (name, f"{node}.trajectory=csv", f"{node}.trajectory_file={tmp_path}")
        said = refused(*given[:2], f"{given[2]}/{other}.csv")
        assert f"allowed: time and {own.partition('_')[0]} (rename" in said
        Cell(load(*given[:2], f"{given[2]}/{own}.csv").nodes)


def test_a_folder_does_not_hide_a_scenario_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "piston").mkdir()
    assert resources.scenario(Path("piston")) == CONFIG / "piston.yaml"
    assert resources.scenario(Path()) == Path()


# --- counts per sample

BAD, GOOD = (1280, 2048, 3500, 3840, 4096, 4200, 5760, 7000, 8192, 11520), (3000, 3400, 4500, 5000, 10000, 100_000)
NOMINAL = 1000 * np.pi / 30
STEP = 1 / 64_000


def warnings(name, counts, *changes):
    cell = Cell(load(name, *changes).nodes)
    laws = (stage for stage in cell.stages.values() if isinstance(stage, Learner))
    return [said for law in laws for said in law.encoder_warnings(*cell.master.speed_range(), counts)]


def rate_of(said):
    return int(re.search(r"cure: sample_rate = (\d+)", said)[1])


def test_counts_near_a_ratio_of_small_numbers_are_warned_of_and_no_others():
    law = Cell(load("robust").nodes).stages["disturbance_controller"]
    warned = [each for each in (*BAD, *GOOD, 0) if law.encoder_warnings(0.9 * NOMINAL, 1.1 * NOMINAL, each)]
    assert warned == list(BAD)
    assert not law.encoder_warnings(0.98 * NOMINAL, 1.02 * NOMINAL, 4096)  # its speeds stay beside the ratio
    assert "near 1:" in law.encoder_warnings(0.98 * NOMINAL, 1.02 * NOMINAL, 3800)[0]


@pytest.mark.parametrize(
    ("counts", "changes"),
    [(4096, ()), (1365, FAST), (1024, ("sample_rate=16000",)), (8192, ("sample_rate=100000", "nominal_rpm=1500.0"))],
)
def test_the_named_sample_rate_is_clear_of_them_at_other_speeds_and_rates(counts, changes):
    changes = (*changes, "spindle_encoder.deviation_start=0.0")
    (said,) = warnings("robust", counts, *changes)
    assert warnings("robust", counts, *changes, f"sample_rate={rate_of(said)}") == []


def test_edge_times_cure_the_counts_that_are_warned_of():
    """A clock of 1 µs does, as one that the warning names; a clock of about a count or more does not."""
    law, speeds = Cell(load("robust").nodes).stages["disturbance_controller"], (0.9 * NOMINAL, 1.1 * NOMINAL)
    for counts in BAD:
        (said,) = law.encoder_warnings(*speeds, counts)
        clock = float(re.search(r"\(edge_clock = ([\d.e-]+)\)", said)[1])
        assert clock == 1e-6
        assert not law.encoder_warnings(*speeds, counts, clock)
    for clock in (4e-6, 14e-6, 20e-6, 1e-3):
        (said,) = law.encoder_warnings(*speeds, 4096, clock)
        assert "near 1:" in said
    for counts in GOOD:
        assert not law.encoder_warnings(*speeds, counts, 1e-6)
    (said,) = law.encoder_warnings(*speeds, 3000, STEP / 2)
    assert "times of edges to 7.81e-06 s, more than 1/4 of a sample" in said
    assert said.endswith("cure: times of edges (edge_clock = 1e-06)")
    assert not law.encoder_warnings(*speeds, 0, 1e-3)
    assert not law.encoder_warnings(*speeds, 10_000, STEP / 2)  # coarser than a count: as without
    for change in ("edge_clock=1e-6", "reads_per_sample=16"):
        cell = Cell(load("robust", "spindle_encoder.counts_per_revolution=4096", f"spindle_encoder.{change}").nodes)
        cell.check()
        assert cell.warnings == []


def test_laws_without_an_angle_filter_are_not_warned_of():
    assert warnings("speed_deviation", 4096) == []
    assert len(warnings("robust_cutting", 4096, "controller.stage=compound_controller")) == 1


def test_named_sample_rate_halves_the_form_error():
    swing = ("spindle_encoder.deviation_frequency=[20.0]", "spindle_encoder.revolutions=60")
    given = ("robust", "spindle_encoder.counts_per_revolution=4096", *swing)
    seen = []
    result = harness.run(load(*given), watch=seen.append)
    (said,) = result.summary()["warnings"]
    assert [event["message"] for event in seen if event["event"] == "warning"] == [said]
    cured = harness.run(load(*given, f"sample_rate={rate_of(said)}"))
    assert cured.summary()["warnings"] == []
    assert max(cured.errors.largest[50:]) < 0.5 * max(result.errors.largest[50:])


def test_margin_of_each_learning_controller_is_told():
    """The margin is 1 less the largest factor of the check; a law without such a factor has none."""
    cell = Cell(load("two_channel").nodes)
    cell.check()
    assert list(cell.margins) == ["learning_controller", "fine_controller"]
    assert cell.margins == {name: 1.0 - factor for name, factor in cell.factors.items()}
    peer = Cell(load("robust_cutting", "controller.stage=compound_controller").nodes)
    peer.check()
    assert peer.margins == {"controller": None}
