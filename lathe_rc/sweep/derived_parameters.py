# SPDX-License-Identifier: Apache-2.0
"""Derived parameters of a cell, computed by formulas from other parameters."""

import ast
import math
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Any, cast

import simpleeval

from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, shown

_FUNCTIONS = {"sqrt": math.sqrt, "exp": math.exp, "log": math.log, "sin": math.sin, "cos": math.cos}


def _names(formula: str) -> set[str]:
    """Return the parameter targets that occur in a formula."""
    try:
        tree = ast.parse(formula.strip(), mode="eval")
    except SyntaxError:
        raise InputError(f"formula {shown(formula)!r}; allowed: targets and numbers with + - * / ** ( )") from None
    # NODE.PARAM parses as an attribute of a name. Only the full attribute is a target; NODE or a function is not.
    inner = {node.value for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    called = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    named = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute | ast.Name)]
    return {ast.unparse(node) for node in named if node not in inner and node not in called} - {"pi"}


def ordered(ties: Mapping[str, str]) -> list[str]:
    """Return the derived parameters in the order of evaluation, each after those that it depends on.

    Raises:
        InputError: the formulas depend on one another in a cycle.
    """
    depends = {target: _names(formula) & ties.keys() for target, formula in ties.items()}
    try:
        return list(TopologicalSorter(depends).static_order())
    except CycleError as error:
        raise InputError(
            f"{' -> '.join(error.args[1])}: tied in a circle; allowed: formulas of other targets"
        ) from None


class Formulas:
    """Formulas of the derived parameters, parsed once for all cells of a space."""

    def __init__(self, scenario: Scenario, ties: Mapping[str, str]) -> None:
        self._scenario, self._ties = scenario, {target: ties[target] for target in ordered(ties)}
        self._named = {target: _names(formula) for target, formula in ties.items()}
        for names in self._named.values():
            for name in names:
                scenario.parameter(name)  # rejects an unknown parameter
        self._evaluator = simpleeval.SimpleEval(functions=_FUNCTIONS)
        self._parsed = {target: self._evaluator.parse(formula) for target, formula in ties.items()}

    def add_to(self, values: dict[str, Value]) -> dict[str, Value]:
        """Add the derived values to the values of a cell in place; return the cell's values.

        Raises:
            InputError: a formula cannot be evaluated.
        """
        for target, formula in self._ties.items():
            known: dict[str, Any] = {"pi": math.pi}
            for name in self._named[target]:
                node, dot, of = name.partition(".")
                # The cell's values take precedence: they contain the derived targets that this target depends on.
                found = values.get(name, self._scenario.value(name))
                if isinstance(found, list):
                    found = cast("Value", [values.get(f"{name}[{k}]", each) for k, each in enumerate(found)])
                if dot:  # simpleeval reads NODE.PARAM as an entry of a mapping
                    known.setdefault(node, {})[of] = found
                else:
                    known[node] = found
            self._evaluator.names = known
            try:
                found = self._evaluator.eval(formula, previously_parsed=self._parsed[target])
            except (simpleeval.InvalidExpression, ArithmeticError, ValueError, TypeError) as error:
                raise InputError(f"{target} = {shown(formula)}: {shown(error)}") from None
            row = self._scenario.parameter(target)
            whole = row.type is int and isinstance(found, float) and found == round(found)
            values[target] = round(found) if whole else float(found) if row.type is float else found
        return values
