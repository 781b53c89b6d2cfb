# SPDX-License-Identifier: Apache-2.0
"""Start every node of a scenario, the recorder included: ``ros2 launch lathe_rc cell.launch.py``.

``scenario`` names the ROS 2 parameter file, ``bag`` the folder to record to, ``namespace`` that of the nodes,
``allow_code`` a package of the current folder that the scenario names code of; ``log_level`` and ``use_sim_time`` are
those of the nodes;
``NODE.PARAM:=VALUE``, or ``PARAM:=VALUE`` for a shared parameter, replaces a value of the scenario. The run ends when
its last block has been recorded; without a number of revolutions it goes on until Ctrl-C, which ends it with a last
block. A node that fails ends the others, and the launch fails.

This file imports launch and launch_ros alone, since ``ros2`` runs the system's Python: the executable ``launch_plan``
of lathe_rc checks the scenario and says which processes it has.
"""

import atexit
import json
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, TimerAction
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage
from launch_ros.utilities import make_namespace_absolute, prefix_namespace

ARGUMENTS = {
    "scenario": (
        "piston.yaml",
        "ROS 2 parameter file of the cell; NODE.PARAM:=VALUE, or PARAM:=VALUE if shared, replaces one of its values",
    ),
    "bag": ("", "folder to record to, which must not exist; empty: the scenario's, or bag_ and the run id"),
    "namespace": ("", "of the nodes, in the one that an including file has pushed; two cells in one domain need two"),
    "allow_code": ("", "package of the current folder that the scenario names code of"),
    "log_level": ("info", "least level of the nodes' log lines"),
    "use_sim_time": (
        "false",
        "whether the nodes' ROS clocks follow /clock; samples, and the wall time of diagnostics, do not depend on it",
    ),
}  #: default and description
CHOICES = {"log_level": ["debug", "info", "warn", "error", "fatal"], "use_sim_time": ["true", "false"]}
OF_LAUNCH = {"emulate_tty", "launch-prefix", "launch-prefix-filter", "sigkill_timeout", "sigterm_timeout"}
PUSHED = "ros_namespace"  # configuration in which launch_ros keeps what PushRosNamespace has set
LONGEST_END = "60"  # [s] from Ctrl-C to SIGTERM: the digests of a bag are computed as it is closed
PATIENCE = 30.0  # [s] for a cell that has lost a member to end by itself


class CellError(RuntimeError):
    """Reason why the launch fails."""


def generate_launch_description() -> LaunchDescription:
    """Describe the launch; `ros2 launch` calls it."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description, choices=CHOICES.get(name))
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Make the processes of the scenario that the launch arguments name.

    Raises:
        CellError: the scenario cannot work, the bag's folder exists, or there is no such argument.
    """
    folder = tempfile.mkdtemp(prefix="lathe_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    found = plan(context, folder)
    log_level, use_sim_time = (LaunchConfiguration(name).perform(context) for name in CHOICES)
    given = ["--log-level", log_level, "-p", f"use_sim_time:={use_sim_time}"]
    ends = Ends(len(found["processes"]), replaced=found["restarts"])
    return [
        Node(
            package="lathe_rc",
            executable="container",
            exec_name=process["label"],
            namespace=found["namespace"],
            arguments=process["arguments"],
            parameters=[found["file"]],
            ros_arguments=["--enclave", process["enclave"], *given],
            additional_env={"LATHE_ENDS_WITH_PARENT": "1"},
            sigterm_timeout=LaunchConfiguration("sigterm_timeout", default=LONGEST_END),
            output="screen",
            on_exit=ends,
        )
        for process in found["processes"]
    ]


def plan(context: LaunchContext, folder: str) -> dict:
    """Ask lathe_rc for the processes of the scenario.

    Raises:
        CellError: see `nodes`.
    """
    asked = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    configurations = dict(context.launch_configurations)
    asked["namespace"] = make_namespace_absolute(
        prefix_namespace(configurations.get(PUSHED), asked["namespace"] or None) or "/"
    )
    asked |= {
        "arguments": configurations,
        "given": given_to_this_file(context),
        "own": [*ARGUMENTS, *OF_LAUNCH, PUSHED],
        "folder": folder,
    }
    program = ExecutableInPackage("launch_plan", package="lathe_rc").perform(context)
    done = subprocess.run([program, json.dumps(asked)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise CellError(done.stderr.strip().removeprefix("lathe: ") or how_it_ended(program, done.returncode))
    sys.stderr.write(done.stderr)
    return json.loads(done.stdout)


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


def how_it_ended(process: str, code: int) -> str:
    """Describe the end of a process by its return code."""
    return (
        f"{process} was killed by {signal.Signals(-code).name}"
        if code < 0
        else f"{process} ended with exit code {code}"
    )


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
            CellError: see `fail`.
        """
        self._running -= 1
        if event.returncode and not context.is_shutdown:
            self._failed.append(how_it_ended(event.process_name, event.returncode))
            if event.returncode > 0 or -event.returncode in (signal.SIGINT, signal.SIGTERM):
                self.fail()
            if self._running and not self._replaced:
                return [TimerAction(period=PATIENCE, actions=[OpaqueFunction(function=lambda _: self.fail())])]
        if not self._running:
            self.fail()
        return None

    def fail(self) -> None:
        """Name those that have failed, once.

        Raises:
            CellError: some have. For launch that is the reason to end the others and to return 1; with a
                `launch.actions.Shutdown` it would return 0.
        """
        told, self._failed = "; ".join(self._failed), []
        if told:
            raise CellError(told)
