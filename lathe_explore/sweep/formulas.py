# SPDX-License-Identifier: Apache-2.0
"""Parameters of a cell from closed-form rules, as a reference for a search.

For a learning controller (`lathe_machine.analysis.learning`), with Q, drive and interpolators as implemented:

- ``learning_gain``: γ = 1, as in paper 001, eqs 1-5;
- ``q_time``: the shortest time with sup|Q - γZ| <= 1 - margin, since the remaining error (1 - Q)/(γZ + 1 - Q) grows
  with ``q_time``;
- ``q_pass``, ``q_stop``, ``q_ripple`` of a flat Q (fir): the widest band with this margin;
- ``lead_time``: the lag of the drive at low frequencies, so that slow changes of the form are not delayed; if no Q has
  the margin with this lead, the lead that allows the shortest ``q_time``; if Q is not free, the lead with the smallest
  sup|Q - γZ|.

For a force controller (`lathe_machine.analysis.pid_tuning`): the PID with the highest crossover that has margins of 60°
and 6 dB. Its plant is the longitudinal slide W with the cut at the last set point F0: (1 - mc)·F0/v0·p·W/(1 + p·T),
where v0 is the velocity that causes F0. The plant includes the feedback delay, but neither limits nor elasticity nor
keyways.
"""

import math
from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy

from lathe_machine.analysis.pid_tuning import fastest
from lathe_machine.plants.cutting_force import SpecificForce
from lathe_machine.stages.cut.cutting_process import CuttingProcessParameters
from lathe_machine.stages.feed.feed_drive import FeedDriveParameters
from lathe_machine.stages.feed.force_controller import ForceController
from lathe_machine.stages.learning.learner import CheckedLoop
from lathe_machine.stages.learning.learner import lag as drive_lag
from lathe_machine.stages.learning.learning_controller import LearningController
from lathe_machine.stages.learning.learning_parameters import LearningControllerParameters
from lathe_machine.transfer import TransferFunction
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

_PID = ("proportional", "integral", "derivative", "derivative_filter")
_LEARNING = {"lead_time", "q_time", "q_pass", "q_stop", "q_ripple", "learning_gain"}
_PHASE_MARGIN, _GAIN_MARGIN = 60.0, 2.0  # [°], factor
_BAND = (0.1, 1e3)  # range of the crossover [rad/s]
MARGIN = 0.05  #: default stability margin
_SHORTEST, _LONGEST = 1e-6, 1e-3  # range of q_time [s]
_GAIN = "γ = 1 (paper 001, eqs 1-5)"
_NONE = 1.0  # [s] used where no q_time exists: longer than all others, but finite for the search
_HALVINGS = 16
_LEADS = 20  # number of leads on the grid, the best of which is refined
_FAR = 2.0  # longest lead of the grid, in lags of the drive


class FormulaValue(NamedTuple):
    """Parameter value given by a formula.

    Attributes:
        value: value of the parameter.
        formula: description of the formula.
    """

    value: float
    formula: str


def settings(scenario: Scenario, targets: Collection[str], margin: float = MARGIN) -> dict[str, FormulaValue]:
    """Return the values of all parameters that have a formula.

    Args:
        scenario: the cell; parameters that are not in ``targets`` keep its values.
        targets: parameters to be computed, ``NODE.PARAM``.
        margin: required stability margin 1 - sup|Q - γZ| of learning.
    """
    cell = Cell(scenario.nodes)
    found: dict[str, FormulaValue] = {}
    for name, stage in cell.stages.items():
        free = {target.rpartition(".")[2] for target in targets if target.rpartition(".")[0] == name}
        if isinstance(stage, ForceController) and free & set(_PID):
            found |= {f"{name}.{key}": value for key, value in _force(scenario, stage).items()}
        if isinstance(stage, LearningController) and free & _LEARNING:
            found |= {f"{name}.{key}": value for key, value in _learning(cell, stage, free, margin).items()}
    return {target: found[target] for target in targets if target in found}


def _learning(cell: Cell, stage: LearningController, free: Collection[str], margin: float) -> dict[str, FormulaValue]:
    loop = stage.checked_loop(cell)
    if not loop.responses:
        return {}
    gain = 1.0 if "learning_gain" in free else stage.parameters.learning_gain
    if stage.parameters.q_filter == "fir":
        return _flat(loop, free, gain, margin)

    def factor(lead: float, q_time: float) -> float:
        """Return sup|Q - γZ|; infinite if the memory is too short for Q."""
        return loop.factor({"lead_time": lead, "q_time": q_time, "learning_gain": gain})

    found: dict[str, FormulaValue] = {}
    lead, q_time = stage.parameters.lead_time, stage.parameters.q_time
    if "lead_time" in free:
        lag = max(map(drive_lag, loop.responses))
        if "q_time" not in free:
            lead = _least(lambda each: factor(each, q_time), _FAR * lag)
            found["lead_time"] = FormulaValue(lead, "T0 with the least sup|Q - γZ|")
        elif _shortest(partial(factor, lag), margin) < _NONE:
            lead = lag
            found["lead_time"] = FormulaValue(lead, "T0 = lag of the drive")
        else:
            lead = _least(lambda each: _shortest(partial(factor, each), margin), _FAR * lag)
            found["lead_time"] = FormulaValue(lead, "T0 that allows the shortest q_time")
    if "q_time" in free:
        q_time = _shortest(partial(factor, lead), margin)
        if q_time == _NONE:
            return {}
        found["q_time"] = FormulaValue(q_time, f"shortest with sup|Q - γZ| <= {1.0 - margin:.4g}")
    if "learning_gain" in free:
        found["learning_gain"] = FormulaValue(gain, _GAIN)
    return found


def _flat(loop: CheckedLoop, free: Collection[str], gain: float, margin: float) -> dict[str, FormulaValue]:
    """Return the values for a flat Q.

    The lead is the lag of the drive if a flat Q with the margin exists for it, else the scenario's value.
    """
    given = loop.stage.parameters
    assert isinstance(given, LearningControllerParameters), "it has a Q"
    stop, ripple = (None if name in free else getattr(given, name) for name in ("q_stop", "q_ripple"))
    leads = [(given.lead_time, "as it is")]
    if "lead_time" in free:
        leads.insert(0, (max(map(drive_lag, loop.responses)), "T0 = lag of the drive"))
    for lead, told in leads:
        values = {"lead_time": lead, "learning_gain": gain}
        if "q_pass" in free:
            flat = loop.flat(1.0 - margin, stop, ripple, values)
        else:
            flat = {} if loop.factor(values) <= 1.0 - margin else None
        if flat is not None:
            why = f"widest flat Q with sup|Q - γZ| <= {1.0 - margin:.4g}"
            found = {name: FormulaValue(value, why) for name, value in flat.items() if isinstance(value, float)}
            return {**found, "lead_time": FormulaValue(lead, told), "learning_gain": FormulaValue(gain, _GAIN)}
    return {}


def _force(scenario: Scenario, stage: ForceController) -> dict[str, FormulaValue]:
    slides = [table for table in scenario.nodes.values() if isinstance(table, FeedDriveParameters)]
    slides = [table for table in slides if table.axis == "longitudinal" and table.model == "dc_screw"]
    cuts = [table for table in scenario.nodes.values() if isinstance(table, CuttingProcessParameters)]
    table = stage.parameters
    force = table.set_point[-1] if table.set_point else 0.0
    if len(slides) != 1 or len(cuts) != 1 or not force > 0.0 or not cuts[0].depth > 0.0:
        return {}
    (slide,), (cut,) = slides, cuts
    material = SpecificForce(cut.kc1, cut.mc, cut.wear_factor)
    velocity = material.feed_for(force / cut.depth, cut.wear) * table.nominal_speed / (2.0 * math.pi)
    way = slide.transfer()
    plant = TransferFunction(way.numerator, way.denominator[:-1])  # velocity instead of position
    plant *= TransferFunction(((1.0 - cut.mc) * force / velocity,), (cut.lag, 1.0) if cut.lag else (1.0,))
    margins = {"phase_margin": math.radians(_PHASE_MARGIN), "gain_margin": _GAIN_MARGIN}
    try:
        gains = fastest(plant, band=_BAND, **margins, wait=table.feedback_delay * table.step)
    except InputError:  # no PID meets these margins, so there is no formula for this plant
        return {}
    values = (gains.proportional, gains.integral, gains.derivative, gains.filter)
    return {name: FormulaValue(value, "PID of 60° and 6 dB") for name, value in zip(_PID, values, strict=True)}


def _least(cost: Callable[[float], float], longest: float) -> float:
    """Return the lead with the lowest cost."""
    # The cost may have several minima, so a coarse grid finds the deepest one, which the bounded search refines.
    leads = np.linspace(0.0, longest, _LEADS + 1)[1:]
    best = int(np.argmin([cost(float(lead)) for lead in leads]))
    ends = float(leads[max(best - 1, 0)]), float(leads[min(best + 1, _LEADS - 1)])
    found = scipy.optimize.minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-8})
    return float(found.x)


def _shortest(factor: Callable[[float], float], margin: float) -> float:
    """Return the shortest Q time for which the factor is at most 1 - margin; `_NONE` if there is none."""
    longest = _LONGEST
    while factor(longest) > 1.0 - margin:  # also where the memory cannot hold Q
        longest /= 2.0
        if longest < _SHORTEST:
            return _NONE
    low, high = math.log(_SHORTEST), math.log(longest)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if factor(math.exp(middle)) <= 1.0 - margin else (middle, high)
    return math.exp(high)
