# SPDX-License-Identifier: Apache-2.0
"""What users read is true: the reference page, links, the examples of the README, scenarios, the launch file."""

import ast
import functools
import importlib.util
import re
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from lathe_rc import __version__, cli, reference
from lathe_rc.cell import ros_yaml, scenario
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stages import STAGES
from lathe_rc.cell.wiring import Cell
from lathe_rc.commands.run import run
from lathe_rc.errors import InputError

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
WITH_PYTHON = [page for page in PAGES if "```python" in page.read_text(encoding="utf-8")]
SCENARIOS = sorted((ROOT / "config").glob("*.yaml"))
FIVE = {"spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder"}
LAUNCH = ROOT / "launch" / "cell.launch.py"

_LINK = re.compile(r"\]\(([^)#]*)(?:#([^)]*))?\)")
_BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
_RUN = re.compile(r"^\$ \./lathe (run .*)$", re.MULTILINE)
_TEST = re.compile(r"`(test_[a-z0-9_]+)`")
_CODE = re.compile(r"```.*?```|`[^`]*`", re.DOTALL)


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """The headings of a page as links call them."""
    found = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in found}


class TestReference:
    def test_page_is_what_the_command_prints(self) -> None:
        printed = CliRunner().invoke(cli.main, ["reference"])
        assert printed.exit_code == 0
        page = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
        assert page == printed.output, "run: ./lathe reference > docs/reference.md"

    @pytest.mark.parametrize("kind", TABLES)
    def test_names_every_parameter_and_topic(self, kind: str) -> None:
        page = reference.page()
        missing = [row for row in TABLES[kind].rows() if f"| `{row}` |" not in page]
        if kind in STAGES:
            stage = STAGES[kind](kind, TABLES[kind]())
            topics = [port.topic for port in [*stage.inputs, *stage.outputs]]
            missing += [topic for topic in [*topics, *stage.sparse_topics] if f"| `{topic}` |" not in page]
        assert missing == []

    def test_has_no_field_without_its_meaning_where_it_has_a_number(self) -> None:
        bare = re.findall(r"^\| `\w+` \| `(?:float|u?int)[^|]*` \|\s*\|$", reference.page(), re.MULTILINE)
        assert bare == []


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    rclpy = pytest.importorskip("rclpy")
    from lathe_rc.harness import free_domain
    from lathe_rc.nodes.exchange import Exchange
    from lathe_rc.nodes.recorder_node import RecorderNode
    from lathe_rc.nodes.report import Reporter
    from lathe_rc.nodes.spindle_node import SpindleNode
    from lathe_rc.nodes.stage_node import StageNode

    bag = tmp_path_factory.mktemp("docs") / "bag"
    kinds = {"spindle_encoder": SpindleNode, "tool": StageNode, "recorder": RecorderNode}
    with pytest.MonkeyPatch.context() as patch, free_domain() as domain:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        rclpy.init(args=["docs", "--ros-args", "-p", f"recorder:bag:={bag}"], domain_id=domain)
        made = {}
        try:
            for kind, node in kinds.items():
                made[kind] = node(kind, kind, Reporter(), Exchange())
                made[kind].trigger_configure()
                made[kind].trigger_activate()
                assert made[kind].failure is None
            yield made
        finally:
            for node in made.values():
                node.finish()
                node.destroy_node()
            rclpy.try_shutdown()


class TestHostTopics:
    """The reference's table of host topics against the nodes themselves."""

    @pytest.mark.parametrize("topic", reference.HOST_TOPICS, ids=lambda topic: topic.name)
    def test_are_published_and_read_as_the_table_says(self, nodes: dict[str, Any], topic: reference.HostTopic) -> None:
        full = topic.name if topic.name.startswith("/") else f"/{topic.name}"
        for kind, node in nodes.items():
            outlets = [outlet for outlet in node.publishers if outlet.topic_name == full]
            inlets = [inlet for inlet in node.subscriptions if inlet.topic_name == full]
            assert bool(outlets) == (kind in topic.publishers), f"{kind} publishes {full}"
            assert bool(inlets) == (kind in topic.subscribers), f"{kind} reads {full}"
            for outlet in outlets:
                package = outlet.msg_type.__module__.partition(".")[0]
                assert f"{package}/msg/{outlet.msg_type.__name__}" == topic.type
                assert outlet.qos_profile.depth == topic.depth
                assert outlet.qos_profile.reliability.name == "RELIABLE"
                assert (outlet.qos_profile.durability.name == "TRANSIENT_LOCAL") == topic.latched


@functools.cache
def names_of_tests() -> set[str]:
    """Names of all tests."""
    found = set()
    for path in Path(__file__).parent.rglob("test_*.py"):
        tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        found |= {node.name for node in tree if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}
    return found


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_test_that_a_page_names_exists(page: Path) -> None:
    lines = enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
    named = {(number, test) for number, line in lines for test in _TEST.findall(line)}
    known = names_of_tests()
    assert [f"{name(page)}:{number}: no test {test}" for number, test in sorted(named) if test not in known] == []


@pytest.mark.parametrize("page", ["cell", "safety"])
def test_every_promise_names_a_test(page: str) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    _, _, table = text.partition("## Which test holds what\n")
    rows = [line for line in table.splitlines() if line.startswith("| ")][2:]
    assert len(rows) >= 20
    assert [row for row in rows if not _TEST.search(row) and "cell.md#" not in row] == []


def test_one_version_stands_everywhere() -> None:
    said = {
        re.search(pattern, (ROOT / path).read_text(encoding="utf-8"))[1]
        for path, pattern in (
            ("setup.py", r'version="(.+?)"'),
            ("package.xml", "<version>(.+?)<"),
            ("msg_defs/package.xml", "<version>(.+?)<"),
        )
    }
    assert said == {__version__}


@pytest.mark.parametrize("page", PAGES, ids=name)
class TestPages:
    def test_links_point_to_what_exists(self, page: Path) -> None:
        broken = []
        for target, anchor in _LINK.findall(_CODE.sub("", page.read_text(encoding="utf-8"))):
            if "://" in target:
                continue
            path = (page.parent / target).resolve() if target else page
            if not path.exists() or (anchor and anchor not in anchors(path)):
                broken.append(f"{target}#{anchor}")
        assert broken == []

    def test_commands_have_options_that_exist(self, page: Path) -> None:
        for line in _RUN.findall(page.read_text(encoding="utf-8")):
            words = [word for word in line.split("|")[0].split("#")[0].split() if word.startswith("--")]
            known = {option for parameter in run.params for option in parameter.opts}
            assert set(words) <= known, line


@pytest.mark.parametrize("page", WITH_PYTHON, ids=name)
def test_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Python of a page runs, all its examples one after the other, as one program."""
    monkeypatch.chdir(tmp_path)
    program = tmp_path / "page.py"
    program.write_text("\n".join(_BLOCK.findall(page.read_text(encoding="utf-8"))), encoding="utf-8")
    runpy.run_path(str(program))


@pytest.mark.parametrize("path", SCENARIOS, ids=name)
class TestScenarios:
    def test_passes_its_check(self, path: Path) -> None:
        Cell(scenario.load(path).nodes).check()

    def test_survives_being_written_out(self, path: Path, tmp_path: Path) -> None:
        loaded = scenario.load(path)
        again = tmp_path / path.name
        again.write_text(loaded.to_yaml(), encoding="utf-8")
        assert scenario.load(again) == loaded


class Action(SimpleNamespace):
    """Stands in for an action of launch: keeps what it is given."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(args=args, **kwargs)


class Configuration:
    """Stands in for LaunchConfiguration; the context is a dict."""

    def __init__(self, key: str) -> None:
        self._key = key

    def perform(self, context: dict[str, str]) -> str:
        return context[self._key]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The launch file, imported with stand-ins for launch and launch_ros."""
    contents = {
        "launch": ("LaunchContext", "LaunchDescription", "LaunchDescriptionEntity"),
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction", "Shutdown"),
        "launch.events": (),
        "launch.events.process": ("ProcessExited",),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
    }
    for module, names in contents.items():
        made = ModuleType(module)
        for attribute in names:
            setattr(
                made, attribute, Configuration if attribute == "LaunchConfiguration" else type(attribute, (Action,), {})
            )
        monkeypatch.setitem(sys.modules, module, made)
    spec = importlib.util.spec_from_file_location("cell_launch", LAUNCH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class TestLaunch:
    @pytest.fixture
    def start(self, launch_file: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
        """What `ros2 launch` does with the description: the actions that it makes, for given arguments."""
        monkeypatch.chdir(tmp_path)

        def run(**given: str) -> list[Any]:
            *declared, last = launch_file.generate_launch_description().args[0]
            context = {argument.args[0]: argument.default_value for argument in declared}
            assert set(given) <= set(context)
            return last.function({**context, **given})

        return run

    def test_starts_the_five_nodes_with_one_file(self, start: Callable[..., Any], tmp_path: Path) -> None:
        nodes = start()
        assert {tuple(node.arguments) for node in nodes} == {(f"{name}:{name}",) for name in FIVE}
        assert all((node.package, node.executable) == ("lathe_rc", "container") for node in nodes)
        (file,) = {parameter for node in nodes for parameter in node.parameters}
        loaded = scenario.load(Path(file))
        assert set(loaded.nodes["spindle_encoder"].members) == FIVE - {"spindle_encoder"}
        assert loaded.nodes["recorder"].bag == str(tmp_path / f"bag_{loaded.shared.run_id}")

    def test_takes_scenario_and_bag(self, start: Callable[..., Any], tmp_path: Path) -> None:
        path = tmp_path / "cell.yaml"
        path.write_text(
            "/spindle: {ros__parameters: {stage: spindle_encoder, revolutions: 2}}\n"
            + "".join(f"/{kind}: {{ros__parameters: {{}}}}\n" for kind in ("learning_controller", "tool"))
            + "/electrodynamic_actuator: {ros__parameters: {delay: 0.36e-3}}\n",
            encoding="utf-8",
        )
        nodes = start(scenario=str(path), bag=str(tmp_path / "elsewhere"))
        assert ["spindle:spindle_encoder"] in [node.arguments for node in nodes]
        values = ros_yaml.read(Path(nodes[0].parameters[0]))
        assert values["recorder"]["bag"] == str(tmp_path / "elsewhere")

    def test_groups_nodes_as_the_scenario_says(self, start: Callable[..., Any]) -> None:
        (together,) = start(scenario="full_cell.yaml")
        assert len(together.arguments) == 13
        assert together.arguments[3:5] == ["fine_controller:learning_controller", "piezo_actuator:piezo_actuator"]

    def test_puts_the_cell_into_a_namespace(self, start: Callable[..., Any]) -> None:
        nodes = start(namespace="/left")
        assert {(node.namespace, *node.ros_arguments) for node in nodes} == {
            ("/left", "--enclave", f"/left/{name}") for name in FIVE
        }

    def test_refuses_a_bag_that_exists(self, start: Callable[..., Any], tmp_path: Path) -> None:
        with pytest.raises(InputError, match="exists"):
            start(bag=str(tmp_path))

    @pytest.mark.parametrize(("code", "ends"), [(0, False), (1, True), (-9, False)])
    def test_a_failed_node_ends_the_others_and_a_killed_one_none(
        self, start: Callable[..., Any], code: int, *, ends: bool
    ) -> None:
        react = start()[0].on_exit
        assert bool(react(SimpleNamespace(returncode=code, process_name="tool-1"), None)) == ends
