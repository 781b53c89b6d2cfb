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
