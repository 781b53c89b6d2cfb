# SPDX-License-Identifier: Apache-2.0
"""Description of a sweep's cell in sweep.json: all that a table and a page need, without the cell's files and code."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, cast

from lathe_explore.sweep import NUMBERS, row
from lathe_explore.sweep.row import Measure
from lathe_rc.cell.parameters import Value, judged
from lathe_rc.cell.scenario import Scenario
from lathe_rc.judge.loops import loops

GOAL = "tool.max_error"  #: default goal; without a tool the largest error of the first loop


@dataclass(frozen=True)
class Target:
    """Varied parameter of a cell.

    Attributes:
        type: type of the value, or of its elements.
        is_list: whether the value is a list.
        unit: unit of the value.
        value: the scenario's own value.
    """

    type: Literal["bool", "int", "float", "str"]
    is_list: bool
    unit: str
    value: Value

    @property
    def is_number(self) -> bool:
        """Whether the value is one number."""
        return self.type in ("int", "float") and not self.is_list


@dataclass(frozen=True)
class Description:
    """Description of a cell.

    Attributes:
        targets: varied parameters.
        goal: column by which cells are ranked by default.
        units: display units by column: the factor from SI units, and the unit's name; other columns have none.
        tolerances: tolerances by column [SI units].
    """

    targets: dict[str, Target] = field(default_factory=dict)
    goal: str = GOAL
    units: dict[str, tuple[float, str]] = field(default_factory=dict)
    tolerances: dict[str, float] = field(default_factory=dict)

    def unit(self, column: str) -> tuple[float, str]:
        """Return the display unit of a column: the factor from SI units, and the unit's name."""
        return self.units.get(column, (1.0, ""))


def describe(scenario: Scenario, targets: Iterable[str], measures: Sequence[Measure]) -> Description:
    """Return the description of a scenario, its varied parameters and its measures."""
    of_loops = (each.name for each in measures if each.node and each.statistic == "max_error")
    forms = [each for each in judged(scenario.nodes).values() if each.quantity == "form"]
    # With zones the largest error alone does not decide.
    tolerances = {GOAL: forms[0].tolerance} if forms and not forms[0].zones else {}
    tolerances |= {f"{loop.node}.max_error": loop.tolerance for loop in loops(judged(scenario.nodes))}
    rows = {target: scenario.parameter(target) for target in targets}
    return Description(
        targets={
            target: Target(
                cast("Literal['bool', 'int', 'float', 'str']", row.type.__name__),
                row.is_list,
                row.unit,
                scenario.value(target),
            )
            for target, row in rows.items()
        },
        goal=GOAL if row.has_tool(scenario) else next(of_loops, GOAL),
        units={name: row.unit(name, scenario) for name in [*NUMBERS, *(each.name for each in measures)]},
        tolerances={name: tolerance for name, tolerance in tolerances.items() if tolerance},
    )
