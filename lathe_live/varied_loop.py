# SPDX-License-Identifier: Apache-2.0
"""Loops of a scenario with other values of lead, Q and gain: margins, curves, refusals and the form error of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_rc.analysis.cycle_factors import DriveMargin
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.batch import CellRunner, Errors
from lathe_rc.cell.parameters import Values
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.judge.loop_curves import LoopCurve, loop_curves
from lathe_rc.signals.form_errors import FormErrors

if TYPE_CHECKING:
    from lathe_machine.stages.learning.learner import Learner

_WIDEST = 2.5  # end of a range, in values of the scenario
_POINTS = 400  # of a response
_REVOLUTIONS = 30.0  # longest run for the form error


def _learners(cell: Cell) -> "list[Learner]":
    return [cast("Learner", stage) for stage in cell.stages.values() if stage.learns]


@dataclass(frozen=True)
class Setting:
    """Parameter that decides whether learning converges, with a range around its value in the scenario.

    Attributes:
        target: ``NODE.PARAM``.
        unit, doc: unit and description of the parameter.
        value: value in the scenario.
        low, high: ends of the range.
    """

    target: str
    unit: str
    doc: str
    value: float
    low: float
    high: float


class Along(NamedTuple):
    """Loops along the range of a setting.

    Attributes:
        setting: the setting.
        values: its values, shape (n,).
        margins: drive margin of the controller, shape (n,); NaN if unknown.
        refused: whether a run refuses the value, shape (n,).
    """

    setting: Setting
    values: Array
    margins: Array
    refused: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class DriveCurve:
    """Frequency response of a drive that a controller commands, from its command to its position.

    Attributes:
        node: name of the controller.
        label: name of the drive, and how its response is known.
        frequency: frequencies [rad/s], increasing, shape (n,).
        value: response, shape (n,).
        measured: whether the points are measured.
    """

    node: str
    label: str
    frequency: Array
    value: Complex
    measured: bool = False


@dataclass(frozen=True)
class LoopState:
    """Loops with some values.

    Attributes:
        refused: why `lathe_rc.cell.wiring.Cell.check` refuses the values; empty: they are accepted.
        margins: stability margin by learning controller, as of ``lathe run``; of refused values, if known.
        drive_margins: drive margins, likewise.
        curves: loop of each controller with a drive margin.
    """

    refused: str
    margins: Mapping[str, float | None] = field(default_factory=dict)
    drive_margins: Mapping[str, DriveMargin] = field(default_factory=dict)
    curves: list[LoopCurve] = field(default_factory=list)


class VariedLoop:
    """Loops of a scenario, which can be evaluated with other values of lead, Q and gain in some milliseconds.

    Args:
        scenario: scenario with values of its own.
        revolutions: length of the runs for the form error; None: at most 30, or as in the scenario.

    Attributes:
        scenario: the scenario.
        cell: its cell.
        revolutions: length of the runs.

    Raises:
        InputError: the scenario is invalid.
    """

    def __init__(self, scenario: Scenario, revolutions: float | None = None) -> None:
        self.scenario, self._named, self._runner = scenario, scenario.named(), CellRunner()
        self.cell = Cell(scenario.nodes)
        (self._master,) = scenario.masters or [self.cell.master.name]
        own = float(getattr(scenario.nodes[self._master], "revolutions", 0.0)) or _REVOLUTIONS
        self.revolutions = revolutions or min(own, _REVOLUTIONS)

    @property
    def learners(self) -> "list[Learner]":
        """Learning controllers, in order of computation."""
        return _learners(self.cell)

    def settings(self) -> list[Setting]:
        """Return the parameters that can be varied."""
        return [self._setting(stage, name) for stage in self.learners for name in stage.adjustable]

    def _setting(self, stage: "Learner", name: str) -> Setting:
        row, value = type(stage.shared).rows()[name], float(getattr(stage.shared, name))
        span = _WIDEST * (value or float(row.default) or 1.0)  # type: ignore[arg-type]
        low, high = max(row.low, min(0.0, span)), min(row.high, max(0.0, span))
        return Setting(f"{stage.name}.{name}", row.unit, row.doc, value, low, high)

    def state(self, values: Values) -> LoopState:
        """Return the loops with some values, by ``NODE.PARAM``."""
        try:
            varied = self._named.varied(values)
            cell, refused = self._checked(varied)
        except InputError as error:
            return LoopState(str(error))
        curves = loop_curves(cell)
        return LoopState(refused, cell.margins, {curve.node: curve.margin for curve in curves}, curves)

    def _checked(self, varied: Scenario) -> tuple[Cell, str]:
        """Return the cell after its checks and why it is refused; a refused one is checked without convergence."""
        cell = self._runner.cell(varied)
        try:
            cell.check(cures=False)
        except InputError as error:
            allowed = {f"{stage.name}.allow_unstable": True for stage in self.learners}
            cell = self._runner.cell(varied.varied(allowed))
            cell.check(cures=False)
            return cell, str(error)
        return cell, ""

    def along(self, values: Values, setting: Setting, points: int = 33) -> Along:
        """Return margins and refusals along the range of a setting, with some values of the others."""
        at = np.linspace(setting.low, setting.high, points)
        margins, refused = np.full(points, np.nan), np.zeros(points, dtype=bool)
        for k, value in enumerate(at.tolist()):
            try:
                cell, why = self._checked(self._named.varied({**values, setting.target: value}))
            except InputError:
                refused[k] = True
            else:
                refused[k] = bool(why)
                own = cell.drive_margins.get(setting.target.partition(".")[0])
                margins[k] = own.error if own else np.nan
        return Along(setting, at, margins, refused)

    def form_errors(self, values: Values) -> FormErrors:
        """Return the form error of a run with some values; without revolutions if the cell has no part.

        Raises:
            LatheError: the values are refused, or the run fails.
        """
        varied = self._named.varied({**values, f"{self._master}.revolutions": self.revolutions})
        cell = self._runner.cell(varied)
        cell.check(cures=False)
        return self._runner.run(cell, Errors(cell, cell.samples - cell.first))


def drive_curves(cell: Cell) -> list[DriveCurve]:
    """Return the responses of all drives that are learned, and the controllers' models of them."""
    found = []
    frequency = np.geomspace(2.0 * np.pi, np.pi / cell.master.shared.step, _POINTS)
    for stage in _learners(cell):
        for response, drive in stage.learned(cell.stages.values()):
            measured = isinstance(response, MeasuredDrive)
            at = response.frequency if isinstance(response, MeasuredDrive) else frequency
            label = f"{drive.name}, {'measured' if measured else getattr(response, 'state', 'simulated')}"
            found.append(DriveCurve(stage.name, label, at, np.asarray(response(at)), measured=measured))
        own = [getattr(stage.shared, f"model_{name}", 0.0) for name in ("natural_frequency", "damping", "delay")]
        if own[0]:
            value = ModalDrive(own[0], own[1], own[2]).response(frequency)
            found.append(DriveCurve(stage.name, f"model of {stage.name}", frequency, value))
    return found
