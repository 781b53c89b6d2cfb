# SPDX-License-Identifier: Apache-2.0
"""Feed, force and position loops in the cell: what their scenarios promise, and the same bits in every host."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lathe_machine.control.predistortion import Predistortion, cancelling, proportional
from lathe_rc import harness
from lathe_rc.cell.scenario import load


def run(name, *overrides):
    return harness.run(load(name, overrides))


def dense(result, topic):
    return result.recording.dense[f"/{topic}"]


@pytest.fixture(scope="module")
def turning():
    return run("force_turning")


def after(result, seconds):
    return round(seconds * result.scenario.shared.sample_rate)


class TestForce:
    def test_is_held_while_the_tool_wears(self, turning):
        cut = dense(turning, "cut")
        settled = slice(after(turning, 2.0), None)
        assert_allclose(cut["force"][settled].mean(), 150.0, atol=0.1)
        # Wear raises the specific force by a fifth; the feed, with the exponent 1 - mc, gives way.
        ends = slice(after(turning, 2.0), after(turning, 5.0)), slice(after(turning, 18.0), None)
        begin, end = (1.0 + 2000.0 * cut["wear"][part].mean() for part in ends)
        depth = [cut["depth_of_cut"][part].mean() for part in ends]
        expected = (begin * depth[0] / (end * depth[1])) ** (1 / 0.75)
        assert_allclose(cut["feed"][ends[1]].mean() / cut["feed"][ends[0]].mean(), expected, rtol=0.02)

    def test_varies_less_than_without_control(self, turning):
        """The force varies less than without control; the paper has a factor of 1.88 for its own allowance."""
        cut = dense(turning, "cut")
        settled = slice(after(turning, 2.0), None)
        free = run("force_turning", *HELD_OPEN)
        disturbed = dense(free, "cut")["force"][settled]
        assert np.std(cut["force"][settled]) < 0.6 * np.std(disturbed - drift(disturbed))

    def test_enters_the_cut_without_overshoot_on_a_ramp(self, turning):
        """A step to 150 N overshoots by more than 8 %, 300 N/s by less than 2 %."""
        quiet = ("cutting_process.allowance_rms=0.0", "cutting_process.run_out_amplitude=[0.0]")
        quiet += ("spindle_encoder.revolutions=50.0", "cutting_process.wear_per_second=0.0")
        smooth = run("force_turning", *quiet)
        step = run("force_turning", *quiet, "force_controller.set_point_ramp=0.0")
        assert dense(smooth, "cut")["force"].max() < 1.02 * 150.0
        assert dense(step, "cut")["force"].max() > 1.08 * 150.0

    def test_dies_away_in_the_gap_as_its_lag_says(self):
        result = run("interrupted_cut", "spindle_encoder.revolutions=60.0")
        cut, angle = dense(result, "cut"), dense(result, "encoder")["angle_true"]
        turn, place = np.divmod(angle, 2 * np.pi)
        gap = np.flatnonzero((turn == 50) & (place > 3.0) & (place < 3.25))
        assert np.all(cut["depth_of_cut"][gap] == 0.0)
        decay = np.exp(-(gap - gap[0]) / 64e3 / 2e-3)
        assert_allclose(cut["force"][gap], cut["force"][gap[0]] * decay, rtol=1e-9)
        assert np.all(cut["depth_of_cut"][(turn == 50) & (place < 3.0)] > 0.0)


#: the cut at the feed of the paper, with nothing controlled
HELD_OPEN = (
    "cutting_process.moved_by=['cross']",
    "longitudinal.axis=cross",
    "force_controller.remap=['longitudinal/command:=cross/command']",
    "force_controller.set_point=[0.0]",
    "force_controller.integral=0.0",
    "longitudinal.velocity_gain=1e-12",
)


def drift(force):
    """The effect of wear alone: a straight line."""
    time = np.arange(force.size)
    return np.polyval(np.polyfit(time, force, 1), time)


class TestApproach:
    def test_comes_from_one_side_and_stays(self):
        result = run("approach")
        slide = dense(result, "cross/state")
        assert np.all(np.diff(slide["position"]) >= -1e-15)
        assert_allclose(slide["position"][-1], 5e-3, atol=1e-9)
        assert slide["position"].max() <= 5e-3 + 1e-9

    def test_motor_feedback_leaves_half_the_gap(self):
        result = run("approach", "feed_drive.feedback=motor")
        assert_allclose(5e-3 - dense(result, "cross/state")["position"][-1], 10e-6, atol=1e-9)

    def test_link_of_the_paper_swings_between_the_samples(self):
        result = run("approach", "position_controller.link=paper", "position_controller.feedback_delay=64")
        assert dense(result, "cross/state")["position"].max() > 1.2 * 5e-3


class TestPeriodicLaw:
    @pytest.fixture(scope="class")
    @classmethod
    def status(cls):
        return run("periodic").recording.sparse["/cross/periodic"].values

    def test_error_falls_as_in_the_paper_in_spite_of_the_delay(self, status):
        assert status["period"] == list(range(1, 9))
        for period, expected in ((1, 0.105), (2, 5.4e-3), (4, 2.2e-3), (8, 1.2e-3)):
            assert_allclose(status["max_error"][period - 1], expected, rtol=0.05)

    def test_is_told_to_be_hyperstable(self, status):
        assert all(status["hyperstable"])
        assert all(
            integral > bound for integral, bound in zip(status["popov_integral"], status["popov_bound"], strict=True)
        )
        assert status["saturated"][-1] == 0
        assert max(status["largest_demand"]) == pytest.approx(0.891, rel=0.01)

    def test_divisor_and_unit_are_a_slower_law_in_other_numbers(self, status):
        """A tenth of the rate, millimetres for metres: the drive has a thousandth of the gain per millimetre."""
        rate = ("sample_rate=10000", "block_size=40", "position_controller.feedback_delay=40")
        divisors = ("position_controller.divisor=10", "feed_drive.divisor=10")
        scaled = run("periodic", *rate, *divisors, "spindle_encoder.revolutions=50.0")
        values = scaled.recording.sparse["/cross/periodic"].values
        assert_allclose(values["max_error"], status["max_error"][:2], rtol=1e-2)


class TestFullCell:
    SHORT = ("spindle_encoder.revolutions=4.0",)

    @pytest.fixture(scope="class")
    @classmethod
    def offline(cls):
        return run("full_cell", *cls.SHORT)

    def test_grouped_processes_give_its_digests(self, offline):
        """In the processes that the scenario names."""
        grouped = harness.run(offline.scenario, mode="processes")
        assert grouped.mode == "grouped"
        assert grouped.digest == offline.digest

    @pytest.mark.system
    def test_recorder_and_loops_in_processes_of_their_own_give_its_digests(self):
        """In a run in which a recorder beside the spindle completes a block while the spindle makes another."""
        longer = run("full_cell", "spindle_encoder.revolutions=40.0")
        loops = ["cutting_process", "longitudinal", "force_controller"]
        inside = [name for name in longer.scenario.nodes if name not in ("recorder", *loops)]
        groups = [inside, loops, ["recorder"]]
        assert harness.run(longer.scenario, mode="processes", groups=groups).digest == longer.digest

    def test_form_force_and_edge_are_held_together(self):
        result = run("full_cell", "spindle_encoder.revolutions=100.0")
        settled = slice(after(result, 3.0), None)
        assert result.errors.rms[-1] < 1e-6
        assert_allclose(dense(result, "cut")["force"][settled].mean(), 150.0, atol=1.0)
        # The edge: the deflection of 58 µm is taken back by the cross feed.
        deflection = dense(result, "cut")["deflection"][settled]
        assert deflection.mean() > 50e-6
        assert np.abs(dense(result, "cross/state")["position"][settled] - deflection).max() < 1e-6


def test_slow_controllers_compute_at_multiples_of_their_divisor():
    slow = ("force_controller.divisor=96", "force_controller.feedback_delay=70", "block_size=50")
    command = dense(run("force_turning", *slow, "spindle_encoder.revolutions=3.0"), "longitudinal/command")["command"]
    changes = np.flatnonzero(np.diff(command)) + 1
    assert changes.size > 10
    assert np.all(changes % 96 == 0)


SHAFT = """
/**: {ros__parameters: {nominal_rpm: 3000.0}}
/spindle_encoder: {ros__parameters: {revolutions: 540.0}}
/position_controller: {ros__parameters: {trajectory: steps}}
/cross: {ros__parameters: {stage: feed_drive, axis: cross}}
/feeder: {ros__parameters: {stage: position_controller, axis: longitudinal, trajectory: csv, trajectory_file: feed.csv}}
/longitudinal: {ros__parameters: {stage: feed_drive, axis: longitudinal, velocity_gain: 12.4e-3}}
/cutting_process: {ros__parameters: {
  lag: 0.0, shaft: centres, shaft_length: 0.04, shaft_diameter: 3e-3, depth: 0.643e-3}}
"""


def test_predistorted_shaft_comes_out_straight(tmp_path):
    """A thin shaft comes out straight where the position loop follows the path that cancels its deflection."""
    (tmp_path / "shaft.yaml").write_text(SHAFT, encoding="utf-8")
    (tmp_path / "feed.csv").write_text("time_s,position_um\n0,0\n10.8,38340\n", encoding="utf-8")
    loaded = load(tmp_path / "shaft.yaml")
    table = loaded.nodes["cutting_process"]
    shaft = table.flexible()
    heights = np.linspace(0.0, shaft.length, 101)
    stiffness = table.kc1 * 1e-3 * (71e-6 / 1e-3) ** 0.75
    path = cancelling(shaft.compliance(heights), proportional(stiffness), table.depth)
    Predistortion(heights, path).save(tmp_path / "path.csv")
    followed = loaded.varied({"position_controller.predistortion_file": str(tmp_path / "path.csv")})
    first, second = (np.ptp(edge(harness.run(each))) for each in (loaded, followed))
    assert first > 20e-6
    assert second < 0.1 * first


def edge(result):
    """Position of the edge out of the part once the cut is steady [m]."""
    settled = slice(after(result, 1.0), None)
    return dense(result, "cut")["deflection"][settled] - dense(result, "cross/state")["position"][settled]
