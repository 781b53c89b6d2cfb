# SPDX-License-Identifier: Apache-2.0
"""Scenario files: one format for every host, overrides, identity, and what is refused."""

from pathlib import Path

import cells
import pytest
from cells import NODES
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import line_of

from lathe_rc import harness
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.scenario import TABLES, Scenario, load

CELL = """
/**:
  ros__parameters:
    block_size: 32
/spindle_encoder:
  ros__parameters: {revolutions: 2.0, deviation_amplitude: [0.1], deviation_frequency: [10.7]}
/learning_controller:
  ros__parameters: {lead_time: 1.425e-3}
/electrodynamic_actuator:
  ros__parameters: {}
/tool:
  ros__parameters: {profile: csv, profile_file: forms/oval.csv}
"""
OVAL = "angle_deg,radius_um\n" + "".join(f"{a},{b}\n" for a, b in ((0, 0), (90, -200), (180, 0), (270, -200)))


@pytest.fixture
def cell(tmp_path):
    """A scenario file with a profile beside it."""
    (tmp_path / "forms").mkdir()
    (tmp_path / "forms" / "oval.csv").write_text(OVAL)
    path = tmp_path / "cell.yaml"
    path.write_text(CELL)
    return path


def refusal(path, *overrides):
    """The one line with which a scenario is refused, at the latest before anything moves."""
    return line_of(lambda: harness.run(load(path, overrides)))


# --- reading


def test_file_gives_every_node_its_table(cell):
    cell.write_text(CELL.replace("/tool:\n  ros__parameters: {", "/edge:\n  ros__parameters: {stage: tool, "))
    scenario = load(cell)
    assert scenario.name == "cell"
    assert [scenario.kind(name) for name in scenario.nodes] == list(NODES)
    assert scenario.of_kind("tool") == ["edge"]
    assert {table.block_size for table in (scenario.shared, *scenario.nodes.values())} == {32}
    assert scenario.nodes["learning_controller"].lead_time == 1.425e-3
    assert scenario.nodes["electrodynamic_actuator"].damping == 0.804


def test_profile_path_is_relative_to_the_file_and_on_the_command_line_to_the_shell(cell, monkeypatch):
    for folder in (cell.parent, "/"):
        monkeypatch.chdir(folder)
        assert load(cell).nodes["tool"].profile_file == str(cell.parent / "forms" / "oval.csv")
        changed = load(cell, ["tool.profile_file=other.csv"])
        assert changed.nodes["tool"].profile_file == str(Path(folder, "other.csv"))


def test_scenario_runs(cell):
    assert harness.run(load(cell)).errors.rms.size == 2


# --- overrides


@pytest.mark.parametrize(
    ("override", "name", "value"),
    [
        ("learning_controller.allow_unstable=yes", "allow_unstable", True),
        ("learning_controller.events=['revolution 1: freeze']", "events", ["revolution 1: freeze"]),
        ("spindle_encoder.deviation_amplitude=[]", "deviation_amplitude", []),
        ("tool.profile_file=", "profile_file", ""),
        (" tool.feed =1e-4", "feed", 1e-4),
    ],
)
def test_override_of_a_node(cell, override, name, value):
    node = override.strip().partition(".")[0]
    assert getattr(load(cell, [override]).nodes[node], name) == value


@pytest.mark.parametrize(
    "text", [CELL.replace("{revolutions", "{block_size: 32, revolutions"), CELL[CELL.index("/sp") :]]
)
def test_override_of_a_shared_parameter_holds_for_every_node(cell, text):
    """The last one counts, whether each node has the parameter, or no one does."""
    cell.write_text(text)
    scenario = load(cell, ["block_size=16", "seed=5", "block_size=128"])
    assert {(table.block_size, table.seed) for table in scenario.nodes.values()} == {(128, 5)}


#: of the text of a set and of its target; test_parameters.py has what tables refuse, test_refused_scenarios.py the rest
OVERRIDES = [
    ("block_size", "--set 'block_size'; allowed: NODE.PARAM=VALUE, or PARAM=VALUE for a shared parameter"),
    ("=5", "--set '=5': '' is not shared; not NODE.PARAM=VALUE either; allowed: sample_rate, block_size"),
    ("feed=1e-3", "--set 'feed=1e-3': 'feed' is not shared; did you mean tool.feed?"),
    ("blocksize=8", "'blocksize' is not shared; not NODE.PARAM=VALUE either; did you mean block_size?"),
    ("tol.feed=1", "no node 'tol' in the scenario; did you mean tool?"),
    ("fork.feed=1", "--set 'fork.feed=1': no node 'fork' in the scenario; allowed: spindle_encoder, learning"),
    ("tool.fed=1", "tool.fed: unknown parameter; did you mean feed? (lathe node tool --help lists all)"),
    ("tool.=1", "tool.: unknown parameter"),
    ("tool.feed=fast", "tool.feed = 'fast'; allowed: a finite number from 0 [m/rev]"),
    ("tool.feed={a: 1}", "--set tool.feed: neither a value nor a list"),
    ("tool.feed=[1.0", "--set tool.feed:1: not YAML"),
    ("tool.stage=fork", "tool: no stage 'fork'; allowed: spindle_encoder, encoder_device"),
    ("tool.stage=learnin_controller", "no stage 'learnin_controller'; did you mean learning_controller, resonant_"),
    ("block_size=0", "/**.block_size = 0; allowed: an integer from 1 up to 8192 [sample]"),
    ("tool.block_size=8", "tool.block_size = 8: /** says 32; keep one"),
    ("tool.seed=8", "seed = "),
    ("/**.block_size=8", "no node '/**' in the scenario"),
    ('tool.profile_file="a\\0b"', "allowed: text without NUL"),
]


@pytest.mark.parametrize(("override", "message"), OVERRIDES)
def test_bad_override_is_refused_in_one_line(cell, override, message):
    assert message in refusal(cell, override)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("block_size: 32", "block_sizes: 32", "/**.block_sizes: unknown parameter"),
        ("block_size: 32", "revolutions: 2.0", "/**.revolutions: unknown parameter"),
        ("/tool:", "/fork:", "fork: no stage 'fork'; allowed: spindle_encoder, encoder_device"),
        ("/tool:", "/cell/tool:", "cell/tool: no stage"),
        ("revolutions: 2.0", "window: 3, revolutions: 2.0", "window = "),
        ("  ros__parameters: {}", "  ros_parameters: {}", "actuator does not hold ros__parameters alone"),
        (CELL, "/**: {ros__parameters: {block_size: 32}}", "no nodes beside"),
    ],
)
def test_bad_file_is_refused_in_one_line(cell, old, new, message):
    assert old in CELL
    cell.write_text(CELL.replace(old, new))
    assert message in refusal(cell)


# --- the complete file


def test_complete_file_says_the_same(cell, tmp_path):
    scenario, again = load(cell, ["learning_controller.events=['revolution 1: freeze']"]), tmp_path / "again.yaml"
    again.write_text(scenario.to_yaml())
    assert load(again).nodes == scenario.nodes


texts = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cf", "Zl", "Zp", "Zs", "Cn", "Co"]), max_size=16)
odd_texts = st.sampled_from(["1e-3", "0x10", "010", "y", "n", "yes", ".inf", "1E6", "+5", "~", "nan", "a: b", ""])


@settings(max_examples=20)
@given(
    st.one_of(texts, odd_texts),
    st.lists(st.one_of(texts, odd_texts), max_size=3),
    st.lists(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False), max_size=3),
    st.floats(1e-300, 1e300),
)
def test_every_value_survives_the_complete_file(tmp_path_factory, run_id, names, amplitudes, seconds):
    values = {"run_id": run_id, "members": names, "deviation_amplitude": amplitudes, "deviation_start": seconds}
    table = TABLES["spindle_encoder"].read("spindle_encoder", values)
    path = tmp_path_factory.mktemp("complete") / "complete.yaml"
    path.write_text(Scenario("any", {"spindle_encoder": table}).to_yaml())
    read = ros_yaml.read(path)["spindle_encoder"]
    assert TABLES["spindle_encoder"].read("spindle_encoder", read) == table


# --- identity


def run_id(cell, *overrides):
    return load(cell, overrides).shared.run_id


def test_run_id_is_the_same_for_the_same_content(cell, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "forms").mkdir(parents=True)
    (elsewhere / "forms" / "oval.csv").write_text(OVAL)
    (elsewhere / "other.yaml").write_text("# a comment\n" + CELL.replace("1.425e-3", "0.001425"))
    assert run_id(cell) == run_id(cell) == run_id(elsewhere / "other.yaml")


@pytest.mark.parametrize(
    "host", ["spindle_encoder.speed_factor=0.0", "window=3", "spindle_encoder.members=[tool]", "tool.autostart=false"]
)
def test_run_id_does_not_depend_on_host_and_recorder(cell, host):
    before = run_id(cell)
    cell.write_text(CELL + "/recorder:\n  ros__parameters: {bag: some/where, compression: none}\n")
    assert run_id(cell, host) == before


@pytest.mark.parametrize(
    "content", ["tool.feed=1e-9", "seed=1", "block_size=64", "learning_controller.events=['sample 1: clear']", ""]
)
def test_run_id_depends_on_parameters_and_on_the_points_of_the_profile(cell, content):
    before = run_id(cell)
    if not content:
        (cell.parent / "forms" / "oval.csv").write_text(OVAL.replace("-200", "-201"))
    assert run_id(cell, *filter(None, [content])) != before


def test_run_id_may_be_given(cell):
    assert {table.run_id for table in load(cell, ["run_id=mine"]).nodes.values()} == {"mine"}


def test_a_recorder_that_is_added_takes_only_what_all_nodes_share(tmp_path):
    made = cells.scenario({"block_size": 32}, spindle_encoder={"stage": "spindle_encoder", "autostart": False})
    recorder = harness.with_recorder(made, tmp_path / "bag", keep=True).nodes["recorder"]
    assert (recorder.block_size, recorder.run_id) == (32, "test")
    assert (recorder.stage, recorder.autostart) == ("", True)


@pytest.mark.parametrize("path", ["x" * 5000, "/proc/self/mem", "/proc/kmsg", "/dev/zero"])
def test_the_identity_of_a_run_waits_for_no_file(path, cell):
    """Neither a traceback nor a wait, though it looks at files before anybody needs them."""
    assert run_id(cell, f"learning_controller.memory_file={path}")
