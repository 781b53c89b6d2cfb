# SPDX-License-Identifier: Apache-2.0
"""A refused parameter of a cell is named by node and parameter, wherever it is noticed."""

import re

import pytest

from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError

NODE = "some_node"
# Values that a table takes and a stage may not, by what else is chosen.
CHOSEN = {
    "spindle_encoder": [{"random_rms": 1e-3, "revolutions": 3.0}, {"signal_skew": 0.3}],
    "learning_controller": [{"q_filter": "fir"}, {"correction": "lead_lag"}, {"reaction_delay": 64}],
    "piezo_actuator": [
        {"hysteresis": "prandtl_ishlinskii", "amplifier_lag": 1e-5, "creep_per_decade": 0.01},
        {"hysteresis": "bouc_wen"},
    ],
    "series_drive": [{"fine_compensates": ["coarse"]}],
    "tool": [{"profile": "polygon"}, {"profile": "csv"}],
    "feed_drive": [
        {"model": "fourth_order", "command_velocity": 1.0},
        {"model": "dc_screw", "zero": 1.0},
        {"friction": "lugre"},
        {"friction": "lugre", "lags": [0.1, 0.2]},
    ],
    "cutting_process": [{"allowance_rms": 1e-6}],
    "position_controller": [{"law": "sampled_link"}, {"law": "periodic_hyperstable"}, {"reaction_delay": 64}],
    "supervisor": [{"drives": ["coarse"]}],
}
SINGLE = {bool: [True, False], str: ["x"], int: [1, 1000], float: [1e-9, 1.0, 1e3]}
LISTS = {str: [["x"], ["x", "x"], ["revolution 5: x"]], int: [[3, 2]], float: [[1.0], [-1.0], [2.0, 1.0]]}


def refusals(kind):
    """Parameters that are set, and what is said of them."""
    table = TABLES[kind]
    for chosen in [{}, *CHOSEN.get(kind, [])]:
        for name, row in table.rows().items():
            single = list(row.choices) or SINGLE[row.type]
            for value in LISTS.get(row.type, [[row.choices[:1] * 2]]) if row.is_list else single:
                try:
                    STAGES[kind](NODE, table.read(NODE, {**chosen, name: value}))
                except InputError as error:
                    yield name, str(error)


@pytest.mark.parametrize("kind", STAGES.own)
def test_every_refusal_names_node_and_parameter(kind):
    found = list(refusals(kind))
    assert len(found) > 5
    for name, said in found:
        named = re.match(rf"{NODE}\.(\w+)", said)
        assert named, f"{name}: {said}"
        assert named[1] in TABLES[kind].model_fields, said


@pytest.mark.parametrize(
    ("kind", "values", "said"),
    [
        ("tool", {"sample_rate": 65_536}, "sample_rate = 65536 Hz"),
        ("tool", {"remap": ["tool"]}, "remap = 'tool'; allowed: old:=new"),
        ("tool", {"remap": [":=tool"]}, "remap = ':=tool'"),
        ("tool", {"harmonic_order": [2]}, "harmonic_order, harmonic_amplitude, harmonic_phase: harmonic profile"),
        ("tool", {"profile": "polygon", "polygon_corner_radius": 1.0}, "polygon_corner_radius: polygon: corner radius"),
        ("tool", {"profile": "csv", "profile_file": "/none.csv"}, "profile_file: /none.csv: cannot be read"),
        ("tool", {"events": ["sample 1: freeze"]}, "events: event 'freeze'; allowed: none (tool has no events)"),
        ("tool", {"faults": ["sample 1: tool nap"]}, "faults: "),
        ("learning_controller", {"events": ["sample 1: freese"]}, "events: event 'freese'; did you mean freeze?"),
        ("learning_controller", {"q_time": 0.1}, "q_time: Q filter reaches"),
        ("learning_controller", {"q_filter": "fir", "q_stop": 100.0}, "q_pass, q_stop, q_ripple: FIR Q filter"),
        ("learning_controller", {"correction": "lead_lag"}, "lead_lag_lag: "),
        ("learning_controller", {"deviation_amplitude": [0.1]}, "deviation_amplitude, deviation_frequency, "),
        ("learning_controller", {"memory_file": "/n.npz", "events": ["sample 1: load"]}, "memory_file: /n.npz: "),
        ("spindle_encoder", {"tachogram_time": [2.0, 1.0], "tachogram_deviation": [0.1, 0.1]}, "tachogram_time, tach"),
        ("spindle_encoder", {"random_rms": 0.1, "random_low": 70.0}, "random_low, random_high: random deviation"),
        ("spindle_encoder", {"revolutions": 9.0, "tachogram_time": [0.0], "tachogram_deviation": [-2.0]}, "revolution"),
        ("spindle_encoder", {"faults": ["second 1e300: encoder.angle stuck"]}, "faults = 'second 1e300: fault encoder"),
        ("learning_controller", {"events": ["second 1e300: freeze"]}, "events = 'second 1e300: freeze'; allowed"),
        ("spindle_encoder", {"revolutions": 1e30}, "revolutions = 1e+30, nominal_rpm and its deviations: that takes "),
        ("piezo_actuator", {"play_weights": [0.1]}, "play_thresholds, play_weights, play_proportional: plays: 10 thr"),
        ("series_drive", {"fine_play_weights": [0.1]}, "fine_play_thresholds, fine_play_weights, "),
        ("series_drive", {"fine_use_command": False}, "fine_use_command, fine_use_reference, fine_compensates: "),
        ("vibration", {"line_frequency": [1e9], "line_amplitude": [1e-6]}, "line_frequency: vibration at 1e+09 rad/s"),
        ("feed_drive", {"zero": 1.0}, "velocity_gain, lags, zero: feed drive"),
        ("tool", {"tip_radius": 0.1, "profile": "polygon", "part_radius": 1e-3}, "tip_radius: the form is hollow"),
        ("feed_drive", {"pitch_slope": 1.0}, "pitch_slope, pitch_amplitude, pitch_lead: screw: pitch error"),
        ("feed_drive", {"friction": "lugre", "model": "fourth_order"}, "friction = lugre with model = fourth_order"),
        ("feed_drive", {"friction": "lugre", "friction_static": 1.0}, "friction_coulomb, friction_static: friction: "),
        ("cutting_process", {"hard_spot_start": [1.0]}, "hard_spot_start, hard_spot_width, "),
        ("cutting_process", {"run_out_order": [1]}, "run_out_order, run_out_amplitude, run_out_phase: run-out"),
        ("position_controller", {"law": "sampled_link", "link_gain": 1e6}, "link_gain, link_lag, divisor, feedback_"),
        ("force_controller", {"set_point_time": [1.0, 0.0], "set_point": [1.0, 2.0]}, "set_point_time: [1.0, 0.0] s"),
        ("decoupler", {"w1_numerator": [1.0, 1.0], "w1_denominator": [1.0]}, "w1_numerator, w1_denominator: transfer"),
        ("recorder", {"triggers": ["melt"]}, "triggers = 'melt'; allowed: a pattern"),
    ],
)  # fmt: skip
def test_a_refusal_begins_with_what_to_change(kind, values, said):
    def make():
        table = TABLES[kind].read(NODE, values)
        STAGES[kind](NODE, table)

    with pytest.raises(InputError) as refused:
        make()
    assert str(refused.value).startswith(f"{NODE}.{said}")
    assert str(refused.value).count(NODE) == 1
