# SPDX-License-Identifier: Apache-2.0
"""The launch file, with stand-ins for launch and launch_ros, and the plan that it asks for."""

import contextlib
import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from lathe_rc.cell import ros_yaml, scenario
from lathe_rc.errors import InputError
from lathe_rc.harness import launch_plan

ROOT = Path(__file__).parents[2]
LAUNCH = ROOT / "launch" / "cell.launch.py"
FIVE = {"spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder"}
#: neither lathe_rc nor what it needs, but for the standard library: `ros2` runs the system's Python
MISSING = ("lathe_rc", "annotated_types", "pydantic", "numpy", "yaml")


class Action(SimpleNamespace):
    """An action of launch, replaced: it keeps what it is given."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(args=args, **kwargs)


class Configuration(Action):
    """LaunchConfiguration, replaced."""

    def perform(self, context: SimpleNamespace) -> str:
        return str(context.launch_configurations[self.args[0]])


class Executable(Action):
    """ExecutableInPackage, replaced."""

    def perform(self, context: SimpleNamespace) -> str:
        return f"/opt/lib/{self.package}/{self.args[0]}"


def prefix_namespace(base: str | None, name: str | None) -> str | None:
    """As in launch_ros."""
    return base if name is None else name if not base or name.startswith("/") else f"{base.rstrip('/')}/{name}"


REPLACED = {
    "LaunchConfiguration": Configuration,
    "ExecutableInPackage": Executable,
    "prefix_namespace": prefix_namespace,
    "make_namespace_absolute": lambda name: f"/{name.removeprefix('/')}",
}


def stand_in(name: str) -> Any:
    """A class or function of launch or launch_ros by its name."""
    return REPLACED.get(name) or type(name, (Action,), {})


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The launch file, which finds stand-ins for launch and launch_ros, and no package of others."""
    packages = ("launch", "launch.actions", "launch.events", "launch.events.process", "launch.substitutions")
    with monkeypatch.context() as patch:
        for package in (
            *packages,
            *("launch_ros", "launch_ros.actions", "launch_ros.substitutions", "launch_ros.utilities"),
        ):
            module = ModuleType(package)
            vars(module).update(__getattr__=stand_in)
            patch.setitem(sys.modules, package, module)
        for package in MISSING:
            patch.setitem(sys.modules, package, None)
        return SimpleNamespace(**runpy.run_path(str(LAUNCH)))


def in_this_process(command: list[str], **_: object) -> Any:
    """The program that the launch file starts, without a process of its own."""
    program, asked = command
    assert program == "/opt/lib/lathe_rc/launch_plan"
    try:
        return SimpleNamespace(returncode=0, stdout=json.dumps(launch_plan.plan(json.loads(asked))), stderr="")
    except InputError as error:
        return SimpleNamespace(returncode=error.exit_code, stdout="", stderr=f"lathe: {error}\n")


class TestLaunch:
    @pytest.fixture
    def start(self, launch_file: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
        """The actions that `ros2 launch` makes of the description, for given arguments.

        ``including``: a file that it was given instead, which includes ours and sets the arguments; ``pushed``: the
        namespace that its PushRosNamespace has set.
        """
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(subprocess, "run", in_this_process)

        def run(including: str = "", pushed: str = "", **given: str) -> list[Any]:
            *declared, last = launch_file.generate_launch_description().args[0]
            source = SimpleNamespace(location=including or str(LAUNCH))
            include = launch_file.IncludeLaunchDescription(
                launch_description_source=source, launch_arguments=tuple(given.items())
            )
            event = SimpleNamespace(launch_description=SimpleNamespace(entities=[include]))
            configurations = {argument.args[0]: argument.default_value for argument in declared}
            configurations |= given | ({"ros_namespace": pushed} if pushed else {})
            return last.function(
                SimpleNamespace(launch_configurations=configurations, locals=SimpleNamespace(event=event))
            )

        return run

    def test_starts_the_five_nodes_with_one_file(self, start: Callable[..., Any], tmp_path: Path) -> None:
        """Also in a namespace, where the enclaves are as well."""
        nodes = start(namespace="/left", log_level="warn", use_sim_time="true")
        given = ("--log-level", "warn", "-p", "use_sim_time:=true")
        assert {(tuple(node.arguments), node.namespace, *node.ros_arguments) for node in nodes} == {
            ((f"{name}:{name}",), "/left", "--enclave", f"/left/{name}", *given) for name in FIVE
        }
        assert all((node.package, node.executable) == ("lathe_rc", "container") for node in nodes)
        assert {node.exec_name for node in nodes} == FIVE
        (file,) = {parameter for node in nodes for parameter in node.parameters}
        loaded = scenario.load(Path(file))
        assert set(loaded.nodes["spindle_encoder"].members) == FIVE - {"spindle_encoder"}
        assert loaded.nodes["recorder"].bag == str(tmp_path / f"bag_{loaded.shared.run_id}")

    @pytest.mark.parametrize(
        ("pushed", "given", "namespace"),
        [
            ("", {}, "/"),
            ("", {"namespace": "left"}, "/left"),
            ("/shop", {}, "/shop"),
            ("/shop", {"namespace": "left"}, "/shop/left"),
            ("/shop", {"namespace": "/left"}, "/left"),
        ],
    )
    def test_takes_a_pushed_namespace_and_one_without_slash(
        self, start: Callable[..., Any], pushed: str, given: dict[str, str], namespace: str
    ) -> None:
        nodes = start("/mine.launch.py", pushed, **given)
        assert {node.namespace for node in nodes} == {namespace}
        assert nodes[0].ros_arguments[:2] == ["--enclave", f"{namespace.rstrip('/')}/spindle_encoder"]

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
        with pytest.raises(RuntimeError, match="exists"):
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
            ("spindle_encoder.members", "spindle_encoder.members: no node 'far' in the scenario; allowed: learning"),
            ("revolutions", "no launch argument 'revolutions'; allowed: scenario, .*NODE.* .*nominal_rpm"),
            ("spindle.revolutions", "no node 'spindle' in the scenario; did you mean spindle_encoder?"),
            ("spindle_encoder.revolution", "spindle_encoder.revolution: unknown parameter; did you mean revolutions"),
            ("tool.feed", "tool.feed = 'far'; allowed: a finite number"),
        ],
    )
    def test_refuses_an_argument_that_there_is_not(self, start: Callable[..., Any], argument: str, said: str) -> None:
        with pytest.raises(RuntimeError, match=said):
            start(**{argument: "[far]" if argument.endswith("members") else "far"})

    def test_names_a_program_that_says_nothing(
        self, start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        killed = SimpleNamespace(returncode=-9, stdout="", stderr="")
        monkeypatch.setattr(subprocess, "run", lambda *_, **__: killed)
        with pytest.raises(RuntimeError, match=r"^/opt/lib/lathe_rc/launch_plan was killed by SIGKILL$"):
            start()

    def test_leaves_arguments_of_a_file_that_includes_it_alone(self, start: Callable[..., Any]) -> None:
        assert len(start("/mine.launch.py", turns="2", sigterm_timeout="9")) == 5
        assert len(start(sigterm_timeout="9")) == 5


def test_the_plan_comes_from_a_program_of_its_own(tmp_path: Path) -> None:
    asked = {"scenario": "piston.yaml", "bag": "bag", "namespace": "/left", "allow_code": "", "folder": str(tmp_path)}
    asked |= {"arguments": {"block_size": "32"}, "given": [], "own": []}
    command = [sys.executable, "-m", "lathe_rc.harness.launch_plan", json.dumps(asked)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert json.loads(done.stdout)["namespace"] == "/left"
    assert scenario.load(tmp_path / "scenario.yaml").shared.block_size == 32


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
            pytest.param([], ("tool-1", -15), "tool-1 was killed by SIGTERM$", id="ended before it handles signals"),
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
        with pytest.raises(RuntimeError, match=f"^{error}") if error else contextlib.nullcontext():
            assert not ended(*last)

    def test_nodes_that_are_told_to_end_are_not_named(self, ended: Callable[..., Any]) -> None:
        ended("tool-1", -11)
        assert not ended("recorder-2", 1, told_to=True)
        with pytest.raises(RuntimeError, match=r"^tool-1 was killed by SIGSEGV$"):
            ended("spindle-3", -2, told_to=True)

    def test_a_killed_node_is_not_waited_for_for_ever(self, ended: Callable[..., Any], launch_file: Any) -> None:
        """Launch ends a cell that has not begun 30 s after a node was killed.

        The cell has not begun, and the others do not know that they wait in vain.
        """
        (timer,) = ended("tool-1", -9)
        with pytest.raises(RuntimeError, match=r"^tool-1 was killed by SIGKILL$"):
            timer.actions[0].function(None)
        killed = SimpleNamespace(process_name="learning_controller-1", returncode=-9)
        answer = launch_file.Ends(3, replaced=True)(killed, SimpleNamespace(is_shutdown=False))
        assert answer is None, "another one may come and go on from its restart_file"
