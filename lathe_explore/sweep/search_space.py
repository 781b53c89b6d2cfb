# SPDX-License-Identifier: Apache-2.0
"""Search space of a tuning: parameter ranges and lists as Optuna distributions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import Trial

from lathe_explore.sweep.distributions import number
from lathe_explore.sweep.space import axis, canonical
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, shown


class Dimension(NamedTuple):
    """Free parameter of a search.

    Attributes:
        distribution: Optuna distribution.
        choices: values of a list by the strings that represent them in Optuna; None for a range.
    """

    distribution: CategoricalDistribution | FloatDistribution | IntDistribution
    choices: Mapping[str, Value] | None

    @property
    def ends(self) -> list[Value]:
        """Ends of the parameter's range, or all values of its list."""
        if isinstance(self.distribution, CategoricalDistribution):
            return list((self.choices or {}).values())
        return [self.distribution.low, self.distribution.high]

    def value(self, encoded: Any) -> Value:
        """Decode a value drawn by Optuna."""
        return cast("Value", encoded) if self.choices is None else self.choices[encoded]

    def encoded(self, value: Value) -> Any:
        """Encode a parameter value for Optuna."""
        return value if self.choices is None else _text(value)

    def suggest(self, trial: Trial, target: str) -> None:
        """Draw the parameter's value for a trial, unless the trial already has one."""
        found = self.distribution
        if isinstance(found, CategoricalDistribution):
            trial.suggest_categorical(target, found.choices)
        elif isinstance(found, IntDistribution):
            trial.suggest_int(target, found.low, found.high, log=found.log)
        else:
            trial.suggest_float(target, found.low, found.high, log=found.log)

    def contains(self, value: Value) -> bool:
        """Return whether a value is in the range or list."""
        if self.choices is not None:
            return _text(value) in self.choices
        low, high = cast("list[float]", self.ends)
        return low <= cast("float", value) <= high


def _text(value: Value) -> str:
    return canonical({"": value})


def search_space(scenario: Scenario, free: Mapping[str, str | Sequence[Value]]) -> dict[str, Dimension]:
    """Parse the free parameters of a scenario into dimensions, by target.

    Args:
        scenario: scenario whose own values are the start of the search.
        free: ``LOW:HIGH``, ``LOW:HIGH:log``, or values: ``A,B,C`` or a list.

    Raises:
        InputError: a range or list is invalid for its parameter, or does not contain the start.
    """
    if not free:
        raise InputError("nothing is free; allowed: --free NODE.PARAM=LOW:HIGH, =LOW:HIGH:log or =A,B,C, once or more")
    found = {}
    for target, told in free.items():
        found[target] = _dimension(scenario, target, told)
        for value in found[target].ends:
            scenario.varied({target: value})
        start = scenario.value(target)
        if not found[target].contains(start):
            text = told if isinstance(told, str) else ", ".join(map(str, told))
            raise InputError(
                f"{target} = {shown(start)} is where the search starts, outside of {shown(text)}; allowed: a range or "
                "list with it, or another start (--set)"
            )
    return found


def _dimension(scenario: Scenario, target: str, told: str | Sequence[Value]) -> Dimension:
    row = scenario.parameter(target)
    parts = told.split(":") if isinstance(told, str) else []
    if len(parts) < 2 or row.is_list or row.type not in (int, float):
        values = axis(scenario, target, told)
        if row.type is float and not row.is_list:
            values = [float(cast("float", value)) for value in values]
        # Optuna's choices must be scalars, so strings represent the values, which may be lists.
        choices = {_text(value): value for value in values}
        if len(choices) < 2:
            raise InputError(
                f"{target}={shown(told)}: one value is no choice; allowed: LOW:HIGH, or two and more values"
            )
        return Dimension(CategoricalDistribution(list(choices)), choices)
    log = parts[2:] == ["log"]
    if len(parts) != 2 + log:
        raise InputError(f"{target}={shown(told)}; allowed: LOW:HIGH, LOW:HIGH:log, or values between commas")
    low, high = (number(scenario, target, text) for text in parts[:2])
    if not low < high:
        raise InputError(f"{target}={shown(told)}: an empty range; allowed: LOW below HIGH")
    if log and not low > 0.0:
        raise InputError(f"{target}={shown(told)}; allowed on a log range: ends above 0")
    if row.type is float:
        return Dimension(FloatDistribution(low, high, log=log), None)
    if low != round(low) or high != round(high):
        raise InputError(f"{target}={shown(told)}; allowed: whole numbers")
    return Dimension(IntDistribution(round(low), round(high), log=log), None)
