# SPDX-License-Identifier: Apache-2.0
"""Parameters that change in a run: as events of a scenario, by ``ros2 param set``, and again in a re-simulation."""

from typing import NamedTuple

import numpy as np
import pytest
from cells import assert_resimulated, config, run, scenario
from numpy.testing import assert_allclose

from lathe_machine import Law, LawParameters
from lathe_rc import allowed_code, harness, parameter
from lathe_rc.cell.wiring import Cell

EVENTS = "/learning_controller/events"
LENGTH = {"revolutions": 16.0}


def tuned(*events, shared=None, **controller):
    return run(shared, spindle_encoder=LENGTH, learning_controller={"events": [*events], **controller})


def signals(result):
    """The digests without that of the events, which tell the change itself."""
    return {topic: digest for topic, digest in result.digest.items() if topic != EVENTS}


class GainParameters(LawParameters):
    gain: float = parameter(0.002, "of a sample")


class Memory(NamedTuple):
    gain: float
    sum: np.ndarray


class Integral(Law):
    """A law of one's own."""

    Parameters = GainParameters
    tunable = ("gain",)

    @staticmethod
    def sample(memory, now):
        memory.sum[0] += memory.gain * now.error
        return memory.sum[0]

    def start(self):
        return Memory(self.parameters.gain, np.zeros(1))

    def tune(self, parameters):
        self.parameters = parameters
        self.law = self.law._replace(gain=parameters.gain)


# --- as events


@pytest.mark.parametrize(
    ("value", "controller"),
    [
        pytest.param("learning_gain 0.6", {}, id="gain"),
        pytest.param("lead_time 1.2e-3", {}, id="lead"),
        pytest.param("q_time 300e-6", {}, id="a wider Q"),
        pytest.param("q_time 150e-6", {"q_filter": "gaussian"}, id="a Q of its own chunks"),
    ],
)
def test_a_parameter_that_is_set_has_the_effect_of_one_given_at_the_start_whatever_the_blocks(value, controller):
    """A run in which a parameter is set ends with the error of a run that began with it."""
    name, _, number = value.partition(" ")
    late = [tuned(f"revolution 3.3: set {value}", shared={"block_size": size}, **controller) for size in (64, 1000)]
    assert late[0].digest == late[1].digest
    before, after = tuned(**controller), tuned(**controller, **{name: float(number)})
    assert_allclose(late[0].errors.rms[:3], before.errors.rms[:3], rtol=0)
    assert_allclose(late[0].errors.rms[-1], after.errors.rms[-1], rtol=0.05)
    assert late[0].digest["/coarse/command"] != before.digest["/coarse/command"]


def test_an_event_has_its_sample_and_an_equal_value_changes_no_bit():
    """An event that sets a parameter takes effect at its sample, and is recorded."""
    plain, by_turn = tuned(), tuned("revolution 5: set learning_gain 1.0")
    assert signals(by_turn) == signals(plain)
    said = by_turn.recording.sparse[EVENTS].values
    angle = by_turn.recording.dense["/encoder"]["angle"]
    assert said["action"] == ["set learning_gain 1.0"]
    (sample,) = said["sample_index"]
    assert angle[sample - 1] < 5 * 2 * np.pi <= angle[sample]
    first = tuned("revolution 5: set learning_gain 0.4")
    assert first.digest == tuned(f"sample {sample}: set learning_gain 0.4").digest
    assert signals(first) != signals(plain)


def test_a_q_that_is_wider_than_the_memory_keeps_continues_with_the_learned_form():
    """The newest cycle stands in for points that a wider Q reads and that are no longer kept."""
    wide, event = {"q_time": 1.075e-3}, "revolution 6: set q_time 1.075e-3"
    stages = [Cell(scenario(learning_controller=given).nodes).stages for given in ({}, wide)]
    before, after = (each["learning_controller"]._controller.table.memory.size for each in stages)
    assert before < after
    # The first revolution after the change reads what has been learned, smoothed by the wider Q.
    late, whole = tuned(event).errors.rms, tuned(**wide).errors.rms
    assert_allclose(late[-1], whole[-1], rtol=0.05)
    assert late[6:8].max() < 2.0 * whole[-1]


def test_the_disturbance_law_takes_another_gain():
    gains = [[], ["revolution 4: set learning_gain 0.0"], ["revolution 4: set learning_gain 0.5"]]
    length = ["spindle_encoder.revolutions=6", "spindle_encoder.speed_factor=0"]
    plain, none, equal = (
        harness.run(config("robust", *length, f"disturbance_controller.events={events}")).digest["/coarse/command"]
        for events in gains
    )
    assert equal == plain != none


def test_a_law_of_ones_own_is_tuned():
    allowed_code.allow_named("test_tunable:Integral")

    def command(*events):
        own = {"stage": "test_tunable:Integral", "feedback_delay": 64, "stop_ratio": 10.0, "events": [*events]}
        result = run(spindle_encoder={"revolutions": 2.0}, learning_controller=own)
        return result.recording.dense["/coarse/command"]["position"]

    plain, held = command(), command("sample 1000: set gain 0.0")
    assert np.array_equal(held[:1000], plain[:1000])
    assert np.all(held[1000:] == held[999])
    assert not np.all(plain[1000:] == plain[999])


def test_a_re_simulation_repeats_the_change(tmp_path):
    nodes = scenario(
        spindle_encoder=LENGTH,
        learning_controller={"events": ["second 0.2: set lead_time 1.3e-3", "revolution 6: set learning_gain 0.5"]},
    )
    harness.run(nodes, bag=tmp_path / "bag")
    assert_resimulated(tmp_path / "bag")
