# SPDX-License-Identifier: Apache-2.0
"""The pages are true: the reference page, links, the examples of the README, scenarios, the launch file."""

import ast
import contextlib
import functools
import pkgutil
import re
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pages
import pytest
from click.testing import CliRunner

from lathe_rc import __version__, cli, reference
from lathe_rc.cell import ros_yaml, scenario
from lathe_rc.cell.host_topics import HOST_TOPICS, HostTopic
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.stages import STAGES
from lathe_rc.commands.run import run
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import PACKAGE, store

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
WITH_PYTHON = [page for page in PAGES if "```python\n" in page.read_text(encoding="utf-8")]
FIVE = {"spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder"}
LAUNCH = ROOT / "launch" / "cell.launch.py"

_LINK = re.compile(r"\]\(([^)#]*)(?:#([^)]*))?\)")
_RUN = re.compile(r"^\$ \./lathe (run .*)$", re.MULTILINE)
_TEST = re.compile(r"`((?:(?:system/)?test_\w+\.py::(?:\w+::)?)?test_[a-z0-9_]+)`")
_CODE = re.compile(r"```.*?```|`[^`]*`|<!--.*?-->", re.DOTALL)


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
    from lathe_rc.nodes.cell_node import CellNode
    from lathe_rc.nodes.exchange import Exchange
    from lathe_rc.nodes.recorder_role import RecorderRole
    from lathe_rc.nodes.report import Reporter
    from lathe_rc.nodes.spindle_role import SpindleRole
    from lathe_rc.nodes.stage_role import StageRole

    bag = tmp_path_factory.mktemp("docs") / "bag"
    kinds = {"spindle_encoder": SpindleRole, "tool": StageRole, "recorder": RecorderRole}
    with free_domain() as domain:
        rclpy.init(args=["docs", "--ros-args", "-p", f"recorder:bag:={bag}"], domain_id=domain)
        made = {}
        try:
            for kind, role in kinds.items():
                made[kind] = CellNode(kind, kind, role, Reporter(), Exchange())
                made[kind].trigger_configure()
                made[kind].trigger_activate()
                assert made[kind].protocol.failure is None
            yield made
        finally:
            for node in made.values():
                node.finish()
                node.destroy_node()
            rclpy.try_shutdown()


class TestHostTopics:
    """The reference's table of host topics against the nodes themselves."""

    @pytest.mark.parametrize("topic", HOST_TOPICS, ids=lambda topic: topic.name)
    def test_are_published_and_read_as_the_table_says(self, nodes: dict[str, Any], topic: HostTopic) -> None:
        full = f"/{topic.name.removeprefix('/')}"
        for kind, node in nodes.items():
            outlets = [outlet for outlet in node.publishers if outlet.topic_name == full]
            read = {inlet.topic_name for inlet in node.subscriptions}
            assert bool(outlets) == (kind in topic.publishers), f"{kind} publishes {full}"
            assert (full in read) == (kind in topic.subscribers), f"{kind} reads {full}"
            for outlet in outlets:
                package, qos = outlet.msg_type.__module__.partition(".")[0], outlet.qos_profile
                assert f"{package}/msg/{outlet.msg_type.__name__}" == topic.type
                assert (qos.depth, qos.reliability.name) == (topic.depth, "RELIABLE")
                assert qos.durability.name == topic.durability.replace(" ", "_").upper()


@functools.cache
def names_of_tests() -> set[str]:
    """All tests as pytest calls them, below tests/."""
    found, root = set(), Path(__file__).parent
    for path in root.rglob("test_*.py"):
        file = path.relative_to(root).as_posix()
        for outer in ast.parse(path.read_text(encoding="utf-8")).body:
            owner, body = (f"{outer.name}::", outer.body) if isinstance(outer, ast.ClassDef) else ("", [outer])
            names = [node.name for node in body if isinstance(node, ast.FunctionDef)]
            found |= {f"{file}::{owner}{name}" for name in names if name.startswith("test_")}
    return found


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_test_that_a_page_names_exists(page: Path) -> None:
    lines = enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
    named = {(number, test) for number, line in lines for test in _TEST.findall(line)}
    known = names_of_tests() | {test.rpartition("::")[2] for test in names_of_tests()}
    assert [f"{name(page)}:{number}: no test {test}" for number, test in sorted(named) if test not in known] == []


def exists(name: str) -> bool:
    """Whether a node, NODE.PARAM, Message.field or dotted name of a package exists."""
    first, _, rest = name.partition(".")
    if first in TABLES:
        return not rest or rest in TABLES[first].rows()
    if first in {"lathe_rc", "lathe_papers"}:
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError):
            return False
        return True
    fields = store().fielddefs.get(f"{PACKAGE}/msg/{first}", (None, []))[1]
    return rest in {field for field, _ in fields}


def test_every_name_in_the_table_of_terms_exists() -> None:
    page = (ROOT / "docs" / "terms.md").read_text(encoding="utf-8")
    rows = [row.split("|")[1:-1] for row in page.splitlines() if row.startswith("| ")]
    assert {len(row) for row in rows} == {4}, "a | in a cell has to be written \\lvert"
    names = [found for row in rows[1:] for found in re.findall(r"`([^`]+)`", row[-1])]
    assert len(names) > 80
    assert [found for found in names if not exists(found)] == []


def test_one_version_stands_everywhere() -> None:
    said = {
        re.search(pattern, (ROOT / path).read_text(encoding="utf-8"))[1]
        for path, pattern in (
            ("package.xml", "<version>(.+?)<"),
            ("msg_defs/package.xml", "<version>(.+?)<"),
            ("CITATION.cff", r"(?m)^version: (.+)$"),
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
    """The Python of a page runs, all its examples one after the other, and prints what the page shows."""
    monkeypatch.chdir(tmp_path)
    pages.run_python(page, tmp_path)


class Action(SimpleNamespace):
    """An action of launch, replaced: it keeps what it is given."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(args=args, **kwargs)


class Configuration(Action):
    """LaunchConfiguration, replaced."""

    def perform(self, context: SimpleNamespace) -> str:
        return str(context.launch_configurations[self.args[0]])


def stand_in(name: str) -> type:
    """A class of launch by its name."""
    return Configuration if name == "LaunchConfiguration" else type(name, (Action,), {})


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The launch file, imported with stand-ins for launch and launch_ros."""
    packages = ("launch", "launch.actions", "launch.events", "launch.events.process", "launch.substitutions")
    for package in (*packages, "launch_ros", "launch_ros.actions"):
        module = ModuleType(package)
        vars(module).update(__getattr__=stand_in)
        monkeypatch.setitem(sys.modules, package, module)
    return SimpleNamespace(**runpy.run_path(str(LAUNCH)))


class TestLaunch:
    @pytest.fixture
    def start(self, launch_file: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
        """The actions that `ros2 launch` makes of the description, for given arguments.

        ``including``: a file that it was given instead, which includes ours and sets the arguments.
        """
        monkeypatch.chdir(tmp_path)

        def run(including: str = "", **given: str) -> list[Any]:
            *declared, last = launch_file.generate_launch_description().args[0]
            source = SimpleNamespace(location=including or str(LAUNCH))
            include = launch_file.IncludeLaunchDescription(
                launch_description_source=source, launch_arguments=tuple(given.items())
            )
            event = SimpleNamespace(launch_description=SimpleNamespace(entities=[include]))
            configurations = {argument.args[0]: argument.default_value for argument in declared}
            return last.function(
                SimpleNamespace(launch_configurations=configurations | given, locals=SimpleNamespace(event=event))
            )

        return run

    def test_starts_the_five_nodes_with_one_file(self, start: Callable[..., Any], tmp_path: Path) -> None:
        """Also in a namespace, where the enclaves are as well."""
        nodes = start(namespace="/left")
        assert {(tuple(node.arguments), node.namespace, *node.ros_arguments) for node in nodes} == {
            ((f"{name}:{name}",), "/left", "--enclave", f"/left/{name}") for name in FIVE
        }
        assert all((node.package, node.executable) == ("lathe_rc", "container") for node in nodes)
        assert {node.exec_name for node in nodes} == FIVE
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
        assert together.exec_name == "spindle_encoder+learning_controller+11_more"

    def test_refuses_a_bag_that_exists(self, start: Callable[..., Any], tmp_path: Path) -> None:
        with pytest.raises(InputError, match="exists"):
            start(bag=str(tmp_path))

    def test_replaces_values_of_the_scenario(self, start: Callable[..., Any]) -> None:
        given = {"block_size": "32", "learning_controller.events": "['revolution 2: freeze']"}
        for including in ("", "/mine.launch.py"):
            loaded = scenario.load(Path(start(including, **given)[0].parameters[0]))
            assert loaded.shared.block_size == 32
            assert loaded.nodes["learning_controller"].events == ["revolution 2: freeze"]

    @pytest.mark.parametrize(
        ("argument", "said"),
        [
            (
                "revolutions",
                "no launch argument 'revolutions'; allowed: scenario, bag, namespace, allow_code, NODE.* .*nominal_rpm",
            ),
            ("spindle.revolutions", "no node 'spindle' in the scenario; did you mean spindle_encoder?"),
            ("spindle_encoder.revolution", "spindle_encoder.revolution: unknown parameter; did you mean revolutions"),
            ("tool.feed", "tool.feed = 'far'; allowed: a finite number"),
        ],
    )
    def test_refuses_an_argument_that_there_is_not(self, start: Callable[..., Any], argument: str, said: str) -> None:
        with pytest.raises(InputError, match=said):
            start(**{argument: "far"})

    def test_leaves_arguments_of_a_file_that_includes_it_alone(self, start: Callable[..., Any]) -> None:
        assert len(start("/mine.launch.py", turns="2", sigterm_timeout="9")) == 5
        assert len(start(sigterm_timeout="9")) == 5


class TestEndsUnderLaunch:
    """The answer of launch to ends of processes: an error means that it ends the others and returns 1."""

    @pytest.fixture
    def ended(self, launch_file: Any) -> Callable[..., Any]:
        """Report that a process of a cell of three has ended."""
        reacts = launch_file.Ends(3, replaced=False)

        def report(name: str, code: int, *, told_to: bool = False) -> Any:
            event = SimpleNamespace(process_name=name, returncode=code)
            return reacts(event, SimpleNamespace(is_shutdown=told_to))

        return report

    @pytest.mark.parametrize(
        ("before", "last", "error"),
        [
            pytest.param([("tool-1", 0), ("recorder-2", 0)], ("spindle-3", 0), "", id="in order"),
            pytest.param([], ("tool-1", 2), "tool-1 ended with exit code 2$", id="a failure is named at once"),
            pytest.param(
                [("tool-1", -9), ("recorder-2", 0)],
                ("spindle-3", 0),
                "tool-1 was killed by SIGKILL$",
                id="a killed one when the others have come to the safe state",
            ),
            pytest.param(
                [("tool-1", -9)],
                ("spindle-3", 1),
                "tool-1 was killed by SIGKILL; spindle-3 ended with exit code 1$",
                id="beside one that fails later",
            ),
        ],
    )
    def test_failed_and_killed_nodes_are_named(
        self, ended: Callable[..., Any], before: list[tuple[str, int]], last: tuple[str, int], error: str
    ) -> None:
        for name, code in before:
            assert bool(ended(name, code)) == (code < 0), "a timer ends those that wait for a killed one"
        with pytest.raises(LatheError, match=f"^{error}") if error else contextlib.nullcontext():
            assert not ended(*last)

    def test_nodes_that_are_told_to_end_are_not_named(self, ended: Callable[..., Any]) -> None:
        ended("tool-1", -11)
        assert not ended("recorder-2", 1, told_to=True)
        with pytest.raises(LatheError, match=r"^tool-1 was killed by SIGSEGV$"):
            ended("spindle-3", -2, told_to=True)

    def test_a_killed_node_is_not_waited_for_for_ever(self, ended: Callable[..., Any], launch_file: Any) -> None:
        """Launch ends a cell that has not begun 30 s after a node was killed.

        The cell has not begun, and the others do not know that they wait in vain.
        """
        (timer,) = ended("tool-1", -9)
        with pytest.raises(LatheError, match=r"^tool-1 was killed by SIGKILL$"):
            timer.actions[0].function(None)
        killed = SimpleNamespace(process_name="learning_controller-1", returncode=-9)
        answer = launch_file.Ends(3, replaced=True)(killed, SimpleNamespace(is_shutdown=False))
        assert answer is None, "another one may come and go on from its restart_file"
