# SPDX-License-Identifier: Apache-2.0
"""Formulas of named quantities: derived parameters of a cell, and goals and constraints of its row."""

import ast
import math
import re
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Any, cast

import numpy as np
import pyarrow as pa
import simpleeval
from numpy.typing import NDArray

from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, shown

_FUNCTIONS = {"sqrt": math.sqrt, "exp": math.exp, "log": math.log, "sin": math.sin, "cos": math.cos, "abs": abs}
_FUNCTIONS |= {"min": min, "max": max}
_MEASURE = re.compile(r"[\w/.]+:\w+")  # a column that does not need quotes if it is the whole formula


class Expression:
    """Formula of quantities ``NODE.PARAM``, ``COLUMN``, or, with other characters, ``"TOPIC.FIELD:STATISTIC"``.

    Args:
        text: numbers and names with + - * / ** ( ), ``pi``, ``sqrt``, ``exp``, ``log``, ``sin``, ``cos``, ``abs``,
            ``min`` and ``max``.

    Attributes:
        text: see above.
        names: names of the quantities.

    Raises:
        InputError: the text is no formula.
    """

    def __init__(self, text: str) -> None:
        self.text = text.strip()
        try:
            tree = ast.parse(f'"{self.text}"' if _MEASURE.fullmatch(self.text) else self.text, mode="eval")
        except (SyntaxError, ValueError):
            raise InputError(f"formula {shown(text)!r}; allowed: targets and numbers with + - * / ** ( )") from None
        variables = _Variables()
        self._tree, self._variables = variables.visit(tree).body, variables.found
        self._evaluator = simpleeval.SimpleEval(functions=_FUNCTIONS)

    @property
    def names(self) -> list[str]:
        """Names of the quantities, in the order of their first occurrence."""
        return list(self._variables)

    @property
    def is_column(self) -> bool:
        """Whether the formula is a name alone."""
        return isinstance(self._tree, ast.Name) and bool(self._variables)

    def value(self, known: Mapping[str, Any]) -> Any:
        """Return the value for known quantities.

        Raises:
            InputError: the formula cannot be evaluated.
        """
        self._evaluator.names = {"pi": math.pi, **{each: known[name] for name, each in self._variables.items()}}
        try:
            return self._evaluator.eval(self.text, previously_parsed=self._tree)
        except (simpleeval.InvalidExpression, ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"{shown(self.text)}: {shown(error)}") from None

    def number(self, known: Mapping[str, Any]) -> float:
        """Return the value as a number; NaN where a quantity is missing, or the formula has no finite real value."""
        if any(known[name] is None for name in self._variables):
            return math.nan
        try:
            found = float(self.value(known))
        except (InputError, TypeError, OverflowError):  # for example a division by zero
            return math.nan
        return found if math.isfinite(found) else math.nan

    def numbers(self, table: pa.Table) -> NDArray[np.float64]:
        """Return the value of each row of a table as a number, shape (n,), see `number`."""
        if self.is_column:
            return np.asarray(table.column(self.names[0]).to_numpy(), np.float64)
        return np.array([self.number(row) for row in table.select(self.names).to_pylist()])


class _Variables(ast.NodeTransformer):
    """Replacement of the names in a formula by variables, since simpleeval has no names with dots or colons."""

    def __init__(self) -> None:
        self.found: dict[str, str] = {}

    def _variable(self, name: str) -> ast.Name:
        return ast.Name(self.found.setdefault(name, f"v{len(self.found)}"), ast.Load())

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self._variable(ast.unparse(node))

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return node if node.id == "pi" else self._variable(node.id)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return self._variable(node.value) if isinstance(node.value, str) and ":" in node.value else node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        node.args = [self.visit(each) for each in node.args]
        return node


def ordered(ties: Mapping[str, str]) -> list[str]:
    """Return the derived parameters in the order of evaluation, each after those that it depends on.

    Raises:
        InputError: the formulas depend on one another in a cycle.
    """
    depends = {target: ties.keys() & Expression(formula).names for target, formula in ties.items()}
    try:
        return list(TopologicalSorter(depends).static_order())
    except CycleError as error:
        raise InputError(
            f"{' -> '.join(error.args[1])}: tied in a circle; allowed: formulas of other targets"
        ) from None


class Formulas:
    """Formulas of the derived parameters, parsed once for all cells of a space."""

    def __init__(self, scenario: Scenario, ties: Mapping[str, str]) -> None:
        self._scenario, self._ties = scenario, {target: Expression(ties[target]) for target in ordered(ties)}
        for formula in self._ties.values():
            for name in formula.names:
                scenario.parameter(name)  # rejects an unknown parameter

    def add_to(self, values: dict[str, Value]) -> dict[str, Value]:
        """Add the derived values to the values of a cell in place; return the cell's values.

        Raises:
            InputError: a formula cannot be evaluated.
        """
        for target, formula in self._ties.items():
            known: dict[str, Any] = {}
            for name in formula.names:
                # The cell's values take precedence: they contain the derived targets that this target depends on.
                found = values.get(name, self._scenario.value(name))
                if isinstance(found, list):
                    found = cast("Value", [values.get(f"{name}[{k}]", each) for k, each in enumerate(found)])
                known[name] = found
            try:
                found = formula.value(known)
            except InputError as error:
                raise InputError(f"{target} = {error}") from None
            row = self._scenario.parameter(target)
            whole = row.type is int and isinstance(found, float) and found == round(found)
            values[target] = round(found) if whole else float(found) if row.type is float else found
        return values
