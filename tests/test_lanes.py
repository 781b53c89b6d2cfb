# SPDX-License-Identifier: Apache-2.0
"""Cells in lanes: each gets the bits that it gets alone."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from lathe_rc import resources
from lathe_rc.cell import scenario
from lathe_rc.cell.collect import Collector
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.lanes import Lanes
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

PLAIN = ["learning_controller.identify=false", "fine_controller.identify=false"]


class Kept:
    """Keeps what lanes compute."""

    def __init__(self):
        self._parts = {}

    def chunk(self, first, samples, dense):
        for topic, signals in dense.items():
            for name, array in signals.items():
                self._parts.setdefault((topic, name), []).append(array.copy())

    def lane(self, lane):
        whole = {key: np.concatenate(parts) for key, parts in self._parts.items()}
        return {key: array if array.ndim == 1 else array[:, lane] for key, array in whole.items()}


def cell(name, *overrides, revolutions=6):
    path = resources.find(Path(f"{name}.yaml"))
    return Cell(scenario.load(path, [f"spindle_encoder.revolutions={revolutions}", *overrides]).nodes)


def alone(made):
    engine = Engine(made)
    collector = Collector(made, engine.samples)
    engine.run([collector])
    return collector.recording()


def check(name, variations, revolutions=6):
    """Run variations in lanes and one by one."""
    lanes = Lanes([cell(name, *lane, revolutions=revolutions) for lane in variations])
    kept = Kept()
    lanes.run([kept])
    for number, lane in enumerate(variations):
        recording = alone(cell(name, *lane, revolutions=revolutions))
        for (topic, field), array in kept.lane(number).items():
            expected = recording.dense[f"/{topic}"][field]
            assert array.tobytes() == expected.tobytes(), f"lane {number}: {topic}.{field}"
    return lanes


def between(low, high):
    return st.integers(0, 1000).map(lambda part: low + (high - low) * part / 1000)


lane = st.fixed_dictionaries(
    {
        "learning_controller.lead_time": between(1.3e-3, 1.5e-3),
        "learning_controller.learning_gain": between(0.1, 1.0),
        "learning_controller.q_time": between(0.0, 100e-6),
        "learning_controller.soft_start": st.sampled_from([0.0, 2.5]),
        "fine_controller.join_below": st.sampled_from([0.0, 1e-6, 30e-6]),
        "fine_controller.q_time": between(20e-6, 60e-6),
        "electrodynamic_actuator.delay": between(0.0, 0.5e-3),
        "electrodynamic_actuator.stroke": st.sampled_from([1e-3, 120e-6]),
        "piezo_actuator.amplifier_lag": st.sampled_from([0.0, 40e-6]),
        "piezo_actuator.identified_scale": between(0.8, 1.1),
        "piezo_actuator.stroke": st.sampled_from([15e-6, 4e-6]),
        "tool.start_height": st.sampled_from([0.0, 0.01]),
    }
)


# Without shrinking: a run takes seconds.
@settings(max_examples=8, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(st.lists(lane, min_size=1, max_size=5))
def test_each_lane_has_the_bits_of_its_cell_alone(lanes):
    check("two_channel", [[*PLAIN, *(f"{name}={value!r}" for name, value in lane.items())] for lane in lanes])


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("piston", ["learning_controller.identify=true"]),
        ("piston", ["learning_controller.q_filter=gaussian"]),
        ("piston", ["learning_controller.identify=false", "learning_controller.publish_margin=true"]),
        ("two_channel", ["piezo_actuator.hysteresis=bouc_wen", "electrodynamic_actuator.noise_rms=1e-8"]),
        ("two_channel", ["learning_controller.events=['revolution 3: freeze']"]),
        ("direct_compensation", []),
        ("vibration", []),
        ("supervised", ["supervisor.error_limit=1e-6"]),
    ],
)
def test_what_has_no_kernel_for_lanes_runs_lane_by_lane(name, overrides):
    variations = [[*overrides, f"learning_controller.learning_gain={gain}"] for gain in (0.5, 0.9)]
    check(name, variations, revolutions=5)


@pytest.mark.parametrize("identify", ["true", "false"])
def test_learning_curves_are_those_of_the_status_messages(identify):
    variations = [
        [f"learning_controller.identify={identify}", f"learning_controller.learning_gain={g}"] for g in (0.4, 1.0)
    ]
    rms, largest = check("one_channel", variations).curves()["learning_controller"]
    for number, overrides in enumerate(variations):
        status = alone(cell("one_channel", *overrides)).sparse["/coarse/learning"]
        assert rms[:, number].tolist() == status.values["rms_error"]
        assert largest[:, number].tolist() == status.values["max_error"]


def test_lanes_that_differ_in_more_than_numbers_are_refused():
    with pytest.raises(InputError, match="lane 1: spindle_encoder differs from lane 0"):
        Lanes([cell("piston"), cell("piston", "spindle_encoder.counts_per_revolution=20000")])
    with pytest.raises(InputError, match="lane 1 has the nodes"):
        Lanes([cell("piston"), cell("two_channel")])
    with pytest.raises(InputError, match="lane 1: learning_controller reads or writes otherwise"):
        Lanes([cell("piston"), cell("piston", "learning_controller.feedback_delay=3000")])
    with pytest.raises(InputError, match="lanes need an end"):
        Lanes([cell("piston", revolutions=0)])


def test_a_memory_that_is_read_too_early_is_an_error():
    # The lead alone is more than the cycle leaves.
    late = ["learning_controller.identify=false", "learning_controller.lead_time=0.02"]
    with pytest.raises(Exception, match="learned"):
        Lanes([cell("one_channel", *late), cell("one_channel", *late)]).run()
