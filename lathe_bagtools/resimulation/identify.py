# SPDX-License-Identifier: Apache-2.0
"""Identification of drive models and workpiece form from the signals of a bag."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from lathe_machine.analysis import drive_fit
from lathe_machine.analysis.drive_fit import DriveFit
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator, ElectrodynamicActuatorParameters
from lathe_rc import messages
from lathe_rc.analysis import profile_csv
from lathe_rc.analysis.metrology import evenly
from lathe_rc.bag.reading.recorded import Recorded
from lathe_rc.cell import models
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError
from lathe_rc.files import replacing

_BEYOND = ("mode_frequency", "lag_time")  # parameters of which the identified model has none
_FORM_POINTS = 720


@dataclass(frozen=True)
class IdentifiedDrive:
    """Identified model of a drive.

    Attributes:
        node: name of the drive node.
        command: command topic in the bag.
        position: topic and field of the position in the bag.
        fit: identified model.
        before: values of the same parameters in the scenario; None without a scenario.
    """

    node: str
    command: str
    position: tuple[str, str]
    fit: DriveFit
    before: Mapping[str, float] | None


def drives(recorded: Recorded, scenario: Scenario | None) -> list[IdentifiedDrive]:
    """Identify the electrodynamic drives of a scenario or, without a scenario, the drive on the default topics.

    Raises:
        InputError: there is no such drive, it is not of second order with a gain of 1, the bag lacks its command or
            position, or the signals are insufficient.
        LatheError: samples are missing or not finite.
    """
    kind = ElectrodynamicActuator.kind
    if scenario is None:
        tables: dict[str, NodeParameters] = {kind: ElectrodynamicActuatorParameters()}
    else:
        tables = {name: scenario.nodes[name] for name in scenario.of_kind(kind)}
    if not tables:
        raise InputError(
            f"--identify: no {kind} in the scenario; other drives are not identified: set their parameters"
        )
    return [_drive(recorded, name, table, known=scenario is not None) for name, table in tables.items()]


def _drive(recorded: Recorded, node: str, table: NodeParameters, *, known: bool) -> IdentifiedDrive:
    assert isinstance(table, ElectrodynamicActuatorParameters), "of_kind() says so"
    beyond = {"gain": table.gain} if table.gain != 1.0 else {}
    beyond |= {name: values for name in _BEYOND if (values := getattr(table, name))}
    if known and beyond:
        has = ", ".join(f"{name} = {value}" for name, value in beyond.items())
        raise InputError(
            f"--identify: {node} has {has}; allowed: a drive of second order with a gain of 1 (lathe fit drive "
            f"{recorded.path} fits the others, too)"
        )
    names = {what: remapped(table, f"coarse/{what}") for what in ("command", "state")}
    command = recorded.find(names["command"], messages.COMMAND)
    state = recorded.find(names["state"], messages.STATE)
    tool = recorded.find("tool", messages.TOOL)
    position = (state, "measured_position") if state else (tool, "displacement") if tool else None
    if command is None or position is None:
        missing = [f"its command: {recorded.lacks(names['command'], messages.COMMAND)}"] if command is None else []
        missing += [f"its position: {recorded.lacks(names['state'], messages.STATE)}"] if position is None else []
        raise InputError(
            f"{recorded.path}: {node} cannot be identified without {'; nor without '.join(missing)}; the bag has "
            f"{recorded.holdings()}; leave --identify out and give the drive's parameters with --scenario FILE (lathe "
            f"fit drive {recorded.path} --column ... finds them in messages of any type)"
        )
    topic, field = position
    assert topic is not None, "one of the two is there"
    steps = [recorded.source.step_ns(of) for of in (command, topic)]
    if steps[0] != steps[1]:
        raise InputError(
            f"{recorded.path}: steps of {steps[0]} ns on {command}, {steps[1]} ns on {topic}; record both alike"
        )
    wanted, reached = recorded.whole([(command, "position"), (topic, field)], drive_fit.MOST)
    try:
        fit = drive_fit.fit(
            wanted,
            reached,
            steps[0] * 1e-9,
            method=table.discretisation,
            stroke=table.stroke if known else np.inf,
        )
    except InputError as error:
        raise InputError(f"{recorded.path}: {node} from {command} and {topic}: {error}") from None
    before = {name: float(getattr(table, name)) for name in drive_fit.PARAMETERS} if known else None
    return IdentifiedDrive(node, command, (topic, field), fit, before)


def with_identified(scenario: Scenario, found: Sequence[IdentifiedDrive]) -> Scenario:
    """Return the scenario with the identified parameters in place of its own.

    Raises:
        InputError: a value is invalid in the drive's table.
    """
    if not found:
        return scenario
    nodes = dict(scenario.nodes)
    for drive in found:
        table = nodes[drive.node]
        nodes[drive.node] = type(table).read(drive.node, {**table.model_dump(), **drive.fit.values})
    return Scenario(scenario.name, models.resolved(nodes))


def write_parameters(path: Path, scenario: Scenario | None, found: Sequence[IdentifiedDrive]) -> None:
    """Write a parameter file with the whole scenario or, without a scenario, the identified parameters.

    Files that the scenario refers to are copied into the same folder, because files unpacked from a bag are temporary.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        if scenario is None:
            tree = {f"/{drive.node}": {"ros__parameters": dict(drive.fit.values)} for drive in found}
            text = yaml.safe_dump(tree, sort_keys=False)
        else:
            nodes = {name: _with_files(path, name, table) for name, table in scenario.nodes.items()}
            text = Scenario(scenario.name, nodes).to_yaml()
        with replacing(path) as file:
            file.write(text.encode())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _with_files(path: Path, node: str, table: NodeParameters) -> NodeParameters:
    """Return a node's table with its files copied next to ``path``, and no run ID, since the values have changed."""
    update: dict[str, str] = {"run_id": ""}
    for row in type(table).rows().values():
        file = Path(str(getattr(table, row.name))) if row.is_path else Path()
        if row.is_path and file.is_file():
            beside = path.with_name(f"{path.stem}.{node}.{row.name}{file.suffix}")
            if not (beside.exists() and beside.samefile(file)):
                shutil.copyfile(file, beside)
            update[row.name] = beside.name
    return table.model_copy(update=update)


@dataclass(frozen=True)
class MeanForm:
    """Tool position over the spindle angle, averaged over several revolutions.

    Attributes:
        radius: position at equally spaced angles from 0 [m], shape (points,).
        revolutions: first and last revolution included in the average, counted from 1.
        scatter: RMS deviation of the revolutions from the average [m].
    """

    radius: np.ndarray
    revolutions: tuple[int, int]
    scatter: float


def form(recorded: Recorded) -> MeanForm:
    """Return the recorded tool position over the angle, averaged over the second half of the revolutions.

    Raises:
        InputError: the bag has no encoder, no tool position, or no complete revolution.
        LatheError: samples are missing or not finite.
    """
    tool = recorded.find("tool", messages.TOOL)
    state = recorded.find("coarse/state", messages.STATE)
    if not tool and not state:
        raise InputError(
            f"{recorded.path}: no form without the tool's position: {recorded.lacks('tool', messages.TOOL)}, or "
            f"{recorded.lacks('coarse/state', messages.STATE)}; the bag has {recorded.holdings()}"
        )
    source = (tool, "displacement") if tool else (state or "", "measured_position")
    spindle = recorded.spindle("encoder")
    angle, position = recorded.whole([(spindle.topic, spindle.angle), source])
    angle = angle - spindle.turns
    # An encoder with few counts repeats each value for several samples, of which the first is used.
    new = np.diff(angle, prepend=-np.inf) > 0.0
    every = evenly(angle[new], position[new], _FORM_POINTS)
    if not every.size:
        raise InputError(f"{recorded.path}: no form: not one complete revolution was recorded")
    first = every.shape[0] // 2
    average = every[first:].mean(axis=0)
    return MeanForm(average, (first + 1, every.shape[0]), float(np.sqrt(np.mean((every[first:] - average) ** 2))))


def write_form(path: Path, found: MeanForm) -> None:
    """Write a form as a CSV file for the ``profile_file`` parameter of a tool.

    Raises:
        InputError: the file cannot be written.
    """
    first, last = found.revolutions
    scatter = f"{found.scatter * 1e6:.4g} um RMS"
    profile_csv.write(path, found.radius, comment=f"tool position, revolutions {first} to {last}, scatter {scatter}")
