# SPDX-License-Identifier: Apache-2.0
"""Start every node of a scenario, the recorder included: ``ros2 launch lathe_rc cell.launch.py``.

``scenario`` names the ROS 2 parameter file, ``bag`` the folder to record to, ``namespace`` that of the nodes,
``allow_code`` a package of the current folder that the scenario names code of;
``NODE.PARAM:=VALUE``, or ``PARAM:=VALUE`` for a shared parameter, replaces a value of the scenario. The run ends when
its last block has been recorded; without a number of revolutions it goes on until Ctrl-C. A node that fails ends the
others, and the launch fails.
"""

import atexit
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, TimerAction
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from lathe_rc import allowed_code, harness, resources
from lathe_rc.bag.writing.writer import refuse_existing
from lathe_rc.cell import ros_yaml
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.parameters import SharedParameters
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.names import absolute, checked_namespace

ARGUMENTS = {
    "scenario": (
        str(resources.find(Path("piston.yaml"))),
        "ROS 2 parameter file of the cell; NODE.PARAM:=VALUE, or PARAM:=VALUE if shared, replaces one of its values",
    ),
    "bag": ("", "folder to record to, which must not exist; empty: the scenario's, or bag_ and the run id"),
    "namespace": ("/", "of the nodes; two cells in one domain need one each"),
    "allow_code": ("", "package of the current folder that the scenario names code of"),
}  #: default and description
OF_LAUNCH = {"emulate_tty", "launch-prefix", "launch-prefix-filter", "sigkill_timeout", "sigterm_timeout"}
PATIENCE = 30.0  # [s] for a cell that has lost a member to end by itself
MOST_NAMES = 3  # in the label of a process, which stands before each line that it writes


def generate_launch_description() -> LaunchDescription:
    """Describe the launch; `ros2 launch` calls it."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Make the nodes of the scenario that the launch arguments name.

    Raises:
        InputError: the scenario cannot work, the bag's folder exists, or there is no such argument.
    """
    refuse_unknown(given_to_this_file(context))
    if package := LaunchConfiguration("allow_code").perform(context):
        allowed_code.allow(package)
    path = resources.find(Path(LaunchConfiguration("scenario").perform(context)))
    scenario = replaced(scenarios.load(path), context.launch_configurations.items())
    Cell(scenario.nodes).check()
    namespace = checked_namespace(LaunchConfiguration("namespace").perform(context))
    bag = place(scenario, LaunchConfiguration("bag").perform(context))
    refuse_existing(bag)
    complete = harness.with_recorder(scenario, bag, keep=True)
    file = Path(tempfile.mkdtemp(prefix="lathe_")) / "scenario.yaml"
    file.write_text(complete.to_yaml(), encoding="utf-8")
    atexit.register(shutil.rmtree, file.parent, ignore_errors=True)
    groups = complete.processes()
    restartable = any(getattr(table, "restart_file", "") for table in complete.nodes.values())
    ends = Ends(len(groups), replaced=restartable)
    return [
        Node(
            package="lathe_rc",
            executable="container",
            exec_name=label(group),
            namespace=namespace,
            arguments=[*allowed_code.arguments(), *(f"{name}:{complete.kind(name)}" for name in group)],
            parameters=[str(file)],
            ros_arguments=["--enclave", absolute(namespace, group[0])],
            output="screen",
            on_exit=ends,
        )
        for group in groups
    ]


def given_to_this_file(context: LaunchContext) -> list[str]:
    """Names of the arguments that `ros2 launch` was given, if it was given this file and not one that includes it.

    What it was given is the event that is being handled.
    """
    description = getattr(context.locals.event, "launch_description", None)
    for entity in getattr(description, "entities", ()):
        if isinstance(entity, IncludeLaunchDescription):
            source = Path(entity.launch_description_source.location)
            if source.resolve() == Path(__file__).resolve():
                return [str(name) for name, _ in entity.launch_arguments]
    return []


def replaces(argument: str) -> bool:
    """Whether an argument stands for a value of the scenario."""
    return "." in argument or argument in SharedParameters.model_fields


def refuse_unknown(arguments: Iterable[str]) -> None:
    """Refuse what launch would pass over.

    Raises:
        InputError: there is no such argument.
    """
    for name in arguments:
        if not (name in ARGUMENTS or name in OF_LAUNCH or replaces(name)):
            shared = ", ".join(SharedParameters.model_fields)
            raise InputError(
                f"no launch argument {name!r}; allowed: {', '.join(ARGUMENTS)}, NODE.PARAM for a value of the "
                f"scenario, or a shared one: {shared}"
            )


def replaced(scenario: Scenario, arguments: Iterable[tuple[str, str]]) -> Scenario:
    """The scenario with the values that launch arguments say.

    Raises:
        InputError: no such node or parameter, or a value that it does not take.
    """
    return scenario.varied({name: ros_yaml.parse_value(text, name) for name, text in arguments if replaces(name)})


def place(scenario: Scenario, argument: str) -> Path:
    """Choose the bag's folder: the launch argument, the scenario's own, or one named after the run."""
    recorders = [table for table in scenario.nodes.values() if isinstance(table, RecorderParameters)]
    return Path(argument or next((table.bag for table in recorders if table.bag), f"bag_{scenario.shared.run_id}"))


def label(group: Sequence[str]) -> str:
    """What launch calls a process: the nodes in it, the first ones of many."""
    shown = group if len(group) <= MOST_NAMES else [*group[: MOST_NAMES - 1], f"{len(group) - MOST_NAMES + 1}_more"]
    return "+".join(shown)


class Ends:
    """Hears of the end of each process of the cell; those that are done leave one by one.

    Args:
        running: how many processes there are.
        replaced: whether somebody may start another process of a node that was killed.
    """

    def __init__(self, running: int, *, replaced: bool) -> None:
        self._running, self._replaced = running, replaced
        self._failed: list[str] = []

    def __call__(self, event: ProcessExited, context: LaunchContext) -> list[LaunchDescriptionEntity] | None:
        """End the cell when one of its nodes has failed; what ends because launch has told it to has not.

        When one was killed the time master brings the cell to its safe state, and then fails itself. Before the cell
        has begun the others wait for the killed one: they get some time.

        Raises:
            LatheError: see `fail`.
        """
        self._running -= 1
        if event.returncode and not context.is_shutdown:
            self._failed.append(harness.how_it_ended({"node": event.process_name, "code": event.returncode}))
            if event.returncode > 0:
                self.fail()
            if self._running and not self._replaced:
                return [TimerAction(period=PATIENCE, actions=[OpaqueFunction(function=lambda _: self.fail())])]
        if not self._running:
            self.fail()
        return None

    def fail(self) -> None:
        """Name those that have failed, once.

        Raises:
            LatheError: some have. For launch that is the reason to end the others and to return 1; with a
                `launch.actions.Shutdown` it would return 0.
        """
        told, self._failed = "; ".join(self._failed), []
        if told:
            raise LatheError(told)
