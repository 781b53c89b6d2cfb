# SPDX-License-Identifier: Apache-2.0
"""Executable: the ``launch_plan`` of a scenario, which ``cell.launch.py`` starts: the processes of the cell, as JSON.

``ros2 launch`` runs the system's Python, which need not have the packages of lathe_rc. So the launch file imports none
of them, and this program, in the Python of lathe_rc, knows the rest.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from lathe_rc import allowed_code, resources
from lathe_rc.bag.writing.writer import refuse_existing
from lathe_rc.cell import ros_yaml
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.parameters import SharedParameters
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.harness.processes import with_recorder
from lathe_rc.names import absolute, checked_namespace
from lathe_rc.nodes.arguments import exit_with

_MOST_NAMES = 3  # in the label of a process, which stands before each line that it writes


def plan(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Check a scenario, write its parameter file, and return its processes.

    Args:
        asked: ``scenario``, ``bag``, ``namespace`` and ``allow_code``: the launch arguments of these names;
            ``arguments``: all launch arguments by name; ``given``: names of those on the command line of ``ros2
            launch``; ``own``: names of those that are no values of the scenario; ``folder``: folder of the parameter
            file.

    Returns:
        ``file``: the parameter file; ``namespace``; ``restarts``: whether another process may replace one that was
        killed; ``processes``: label, arguments and enclave of each.

    Raises:
        InputError: the scenario cannot work, the bag's folder exists, or there is no such argument.
    """
    _refuse_unknown(asked["given"], asked["own"])
    if asked["allow_code"]:
        allowed_code.allow(asked["allow_code"])
    values = {name: text for name, text in asked["arguments"].items() if _replaces(name) and name not in asked["own"]}
    scenario = scenarios.load(resources.find(Path(asked["scenario"]))).varied(
        {name: ros_yaml.parse_value(text, name) for name, text in values.items()}
    )
    scenario.check_members()
    Cell(scenario.nodes).check()
    namespace = checked_namespace(asked["namespace"])
    bag = Path(asked["bag"]) if asked["bag"] else scenario.recorder[1].folder
    refuse_existing(bag)
    complete = with_recorder(scenario, bag, keep=True)
    file = Path(asked["folder"]) / "scenario.yaml"
    file.write_text(complete.to_yaml(), encoding="utf-8")
    return {
        "file": str(file),
        "namespace": namespace,
        "restarts": any(getattr(table, "restart_file", "") for table in complete.nodes.values()),
        "processes": [
            {
                "label": _label(group),
                "arguments": [*allowed_code.arguments(), *(f"{name}:{complete.kind(name)}" for name in group)],
                "enclave": absolute(namespace, group[0]),
            }
            for group in complete.processes()
        ],
    }


def _replaces(argument: str) -> bool:
    """Return whether an argument stands for a value of the scenario."""
    return "." in argument or argument in SharedParameters.model_fields


def _refuse_unknown(given: Iterable[str], own: Sequence[str]) -> None:
    """Reject arguments that launch would ignore."""
    for name in given:
        if not (name in own or _replaces(name)):
            shared = ", ".join(SharedParameters.model_fields)
            raise InputError(
                f"no launch argument {name!r}; allowed: scenario, bag, namespace, allow_code, log_level, use_sim_time, "
                f"NODE.PARAM for a value of the scenario, or a shared one: {shared}"
            )


def _label(group: Sequence[str]) -> str:
    """Return the label of a process: the nodes in it, the first ones of many."""
    shown = group if len(group) <= _MOST_NAMES else [*group[: _MOST_NAMES - 1], f"{len(group) - _MOST_NAMES + 1}_more"]
    return "+".join(shown)


def main() -> NoReturn:
    """Print the plan for the request in the only argument, both in JSON, and exit."""

    def work() -> int:
        if len(sys.argv) != 2:
            raise InputError("launch_plan is for cell.launch.py; allowed: ros2 launch lathe_rc cell.launch.py")
        print(json.dumps(plan(json.loads(sys.argv[1]))))
        return 0

    exit_with(work)


if __name__ == "__main__":
    main()
