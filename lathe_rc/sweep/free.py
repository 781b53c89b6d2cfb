# SPDX-License-Identifier: Apache-2.0
"""Free parameters of a tuning: ranges and lists, as Optuna knows them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import Trial

from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, shown
from lathe_rc.sweep.space import axis, canonical, number


class Free(NamedTuple):
    """A free parameter.

    Attributes:
        distribution: where Optuna draws it from.
        choices: the values of a list, by what Optuna knows them as; None: a range.
    """

    distribution: CategoricalDistribution | FloatDistribution | IntDistribution
    choices: Mapping[str, Value] | None

    def value(self, told: Any) -> Value:
        """Of what Optuna has drawn."""
        return cast("Value", told) if self.choices is None else self.choices[told]

    def suggest(self, trial: Trial, target: str) -> None:
        """Let a trial have a value, if it has none yet."""
        found = self.distribution
        if isinstance(found, CategoricalDistribution):
            trial.suggest_categorical(target, found.choices)
        elif isinstance(found, IntDistribution):
            trial.suggest_int(target, found.low, found.high, log=found.log)
        else:
            trial.suggest_float(target, found.low, found.high, log=found.log)

    def told(self, value: Value) -> Any:
        """The form of a value in Optuna."""
        return value if self.choices is None else _known(value)

    def holds(self, value: Value) -> bool:
        """Whether a value is in the range or list."""
        if self.choices is not None:
            return _known(value) in self.choices
        found = cast("FloatDistribution | IntDistribution", self.distribution)
        return found.low <= cast("float", value) <= found.high


def _known(value: Value) -> str:
    return canonical({"": value})


def frees(scenario: Scenario, free: Mapping[str, str | Sequence[Value]]) -> dict[str, Free]:
    """The free parameters of a scenario, by target.

    Args:
        scenario: whose own values are the start.
        free: ``LOW:HIGH``, ``LOW:HIGH:log``, or values: ``A,B,C`` or a list.

    Raises:
        InputError: no range or list of this parameter, or one without the start.
    """
    if not free:
        raise InputError("nothing is free; allowed: --free NODE.PARAM=LOW:HIGH, =LOW:HIGH:log or =A,B,C, once or more")
    found = {}
    for target, told in free.items():
        found[target] = _free(scenario, target, told)
        for value in _ends(found[target]):
            scenario.varied({target: value})
        start = scenario.value(target)
        if not found[target].holds(start):
            text = told if isinstance(told, str) else ", ".join(map(str, told))
            raise InputError(
                f"{target} = {shown(start)} is where the search starts, outside of {shown(text)}; allowed: a range or "
                "list with it, or another start (--set)"
            )
    return found


def _ends(free: Free) -> list[Value]:
    if free.choices is not None:
        return list(free.choices.values())
    found = cast("FloatDistribution | IntDistribution", free.distribution)
    return [found.low, found.high]


def _free(scenario: Scenario, target: str, told: str | Sequence[Value]) -> Free:
    row = scenario.parameter(target)
    parts = told.split(":") if isinstance(told, str) else []
    if len(parts) < 2 or row.is_list or row.type not in (int, float):
        values = axis(scenario, target, told)
        if row.type is float and not row.is_list:
            values = [float(cast("float", value)) for value in values]
        choices = {_known(value): value for value in values}
        if len(choices) < 2:
            raise InputError(
                f"{target}={shown(told)}: one value is no choice; allowed: LOW:HIGH, or two and more values"
            )
        return Free(CategoricalDistribution(list(choices)), choices)
    log = parts[2:] == ["log"]
    if len(parts) != 2 + log:
        raise InputError(f"{target}={shown(told)}; allowed: LOW:HIGH, LOW:HIGH:log, or values between commas")
    low, high = (number(scenario, target, text) for text in parts[:2])
    if not low < high:
        raise InputError(f"{target}={shown(told)}: an empty range; allowed: LOW below HIGH")
    if log and not low > 0.0:
        raise InputError(f"{target}={shown(told)}; allowed on a log range: ends above 0")
    if row.type is float:
        return Free(FloatDistribution(low, high, log=log), None)
    if low != round(low) or high != round(high):
        raise InputError(f"{target}={shown(told)}; allowed: whole numbers")
    return Free(IntDistribution(round(low), round(high), log=log), None)
