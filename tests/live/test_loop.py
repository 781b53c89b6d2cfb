# SPDX-License-Identifier: Apache-2.0
"""``lathe loop``: block diagram from the wiring, loops under other settings."""

import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from lathe_live import loop_figures
from lathe_live.block_diagram import block_diagram
from lathe_live.loop_page import LoopPage
from lathe_live.varied_loop import VariedLoop
from lathe_rc import harness
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

SVG = "{http://www.w3.org/2000/svg}"
LEAD = "learning_controller.lead_time"


def drawn(cell):
    """Connections that a diagram tells under the pointer, and the boxes of its nodes."""
    tree = ET.fromstring(block_diagram(cell))  # noqa: S314
    boxes = [each for each in tree.iter(f"{SVG}g") if each.get("class", "").startswith("box")]
    return [title.text for title in tree.iter(f"{SVG}title")], boxes


class TestDiagram:
    def test_has_each_input_of_the_wiring_once_with_its_delay_in_samples_and_time(self):
        cell = Cell(load("full_cell").nodes)
        told, boxes = drawn(cell)
        inputs = {
            (stage.name, remapped(stage.shared, port.topic), port.delay)
            for stage in cell.stages.values()
            for port in stage.inputs
        }
        assert len(told) == len(inputs)
        assert len(boxes) == len(cell.stages)
        late = sorted(int(found[1]) for text in told if (found := re.search(r"by (\d+) samples = [\d.]+ µs", text)))
        assert late == sorted(delay for _, _, delay in inputs if delay)
        assert "tool: measured_error; delayed by 3200 samples = 50000 µs" in told

    def test_no_two_connections_enter_a_node_at_the_same_place(self):
        svg = block_diagram(Cell(load("full_cell").nodes))
        tips = re.findall(r'<path class="tip[^"]*" d="M ([\d.]+) ([\d.]+)', svg)
        assert len(tips) == len(set(tips)) > 20

    def test_names_from_a_scenario_cannot_close_an_element(self):
        nodes = load("piston").nodes
        nodes = {"<b>" if name == "tool" else name: table for name, table in nodes.items()}
        nodes["<b>"] = nodes["<b>"].model_copy(update={"stage": "tool"})
        assert "<b>" not in block_diagram(Cell(nodes))


class TestSettings:
    def test_of_a_repetitive_law_are_gain_lead_and_q_and_of_others_their_own(self):
        names = [each.target.partition(".")[2] for each in VariedLoop(load("piston")).settings()]
        assert names == ["learning_gain", "lead_time", "q_time"]
        names = [each.target.partition(".")[2] for each in VariedLoop(load("robust")).settings()]
        assert "observer_bandwidth" in names
        assert all(each.low <= each.value <= each.high for each in VariedLoop(load("oval3000")).settings())

    def test_margins_and_form_error_are_those_of_a_run_to_the_last_bit(self):
        loop = VariedLoop(load("piston"), 12.0)
        state, errors = loop.state({LEAD: 1.39e-3}), loop.form_errors({LEAD: 1.39e-3})
        run = harness.run(load("piston", ["spindle_encoder.revolutions=12", f"{LEAD}=1.39e-3"]))
        assert state.refused == ""
        assert state.margins == run.margins
        assert state.drive_margins == run.drive_margins
        assert np.array_equal(errors.largest, run.errors.largest)
        assert state.curves[0].margin == run.drive_margins["learning_controller"]

    def test_refused_values_have_a_reason_and_their_curves_where_these_exist(self):
        loop = VariedLoop(load("piston"))
        state = loop.state({LEAD: 3e-3})
        assert "learning diverges" in state.refused
        assert state.margins["learning_controller"] < 0.0
        assert np.abs(state.curves[0].factor).max() > 1.0
        assert "allowed" in loop.state({LEAD: -1.0}).refused
        assert loop.state({}).refused == "", "no value is left behind"

    def test_the_strip_shades_what_is_refused(self):
        loop = VariedLoop(load("piston"))
        setting = loop.settings()[1]
        along = loop.along({}, setting, 9)
        for value, refused, margin in zip(along.values, along.refused, along.margins, strict=True):
            state = loop.state({LEAD: float(value)})
            assert bool(state.refused) == refused
            assert margin == state.drive_margins["learning_controller"].error
        strip = loop_figures.strip(along, setting.value)
        assert strip.count("refused") == along.refused.sum() > 0
        assert f"accepted from {along.values[~along.refused][0]:.4g}" in strip


class TestPage:
    def test_asks_for_its_own_settings_alone_and_writes_them(self, tmp_path):
        page = LoopPage(VariedLoop(load("piston")), tmp_path / "written.yaml")
        for values in ({"tool.profile_file": "/etc/passwd"}, {LEAD: "1"}, {LEAD: True}, [1]):
            with pytest.raises(InputError, match=r"allowed|no such setting"):
                page.state({"values": values})
        page.write({"values": {LEAD: 1.4e-3}})
        written = load(tmp_path / "written.yaml")
        assert written.nodes == load("piston", [f"{LEAD}=1.4e-3"]).nodes

    def test_a_strip_is_kept_for_its_own_values_alone(self, tmp_path):
        loop = VariedLoop(load("piston"))
        page, setting = LoopPage(loop, tmp_path / "written.yaml"), loop.settings()[0]
        for values in ({setting.target: 0.7}, {}, {LEAD: 1.2e-3}, {LEAD: 1.2e-3, setting.target: 0.7}, {}):
            others = {name: value for name, value in values.items() if name == LEAD}
            strip = loop_figures.strip(loop.along(others, setting), values.get(setting.target, setting.value))
            assert page.along({"values": values, "setting": setting.target}) == {"strip": strip}
