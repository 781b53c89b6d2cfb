# SPDX-License-Identifier: Apache-2.0
"""Probability distributions of sampled parameters, and correlations between them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, shown

_ALLOWED = (
    "allowed: LOW:HIGH, LOW:HIGH:log, uniform:LOW:HIGH, normal:MEAN:DEVIATION or normal:DEVIATION, or a distribution "
    "of scipy.stats with its arguments, such as weibull_min:c=1.5:scale=3e-3; each with :min= and :max="
)


class Distribution(NamedTuple):
    """Probability distribution of a sampled parameter.

    Attributes:
        law: distribution of SciPy.
        first, last: quantiles between which it is truncated.
        log: whether it is the distribution of the logarithm.
        whole: whether the parameter is a whole number.
    """

    law: Any
    first: float = 0.0
    last: float = 1.0
    log: bool = False
    whole: bool = False

    def at(self, quantile: NDArray[np.float64]) -> list[Value]:
        """Return the values of the distribution at quantiles between 0 and 1, shape (n,)."""
        found = self.law.ppf(self.first + (self.last - self.first) * quantile)
        found = np.exp(found) if self.log else found
        return cast("list[Value]", (found.round().astype(np.int64) if self.whole else found).tolist())


def number(scenario: Scenario, target: str, text: str) -> float:
    """Parse a number or a percentage of the scenario's value."""
    plain = text.strip()
    found = ros_yaml.scalar(plain.removesuffix("%"))
    if isinstance(found, bool) or not isinstance(found, int | float) or not math.isfinite(found):
        raise InputError(
            f"{target}: {shown(text)!r} is no number; allowed: numbers, or parts of the scenario's value in %"
        )
    if not plain.endswith("%"):
        return float(found)
    base = scenario.value(target)
    if isinstance(base, bool | str | list):
        raise InputError(f"{target} = {base!r} has no parts in %; allowed: values")
    return float(found) / 100.0 * base


def is_law(told: str) -> bool:
    """Return whether a variation is a distribution by name."""
    return told.partition(":")[0] in ("normal", "uniform") or _scipy_law(told.partition(":")[0]) is not None


def _scipy_law(name: str) -> Any:
    """Return a distribution of SciPy; None if there is none of that name."""
    found = getattr(scipy.stats, name, None) if name.isidentifier() else None
    return found if isinstance(found, scipy.stats.rv_continuous | scipy.stats.rv_discrete) else None


def drawn(scenario: Scenario, target: str, told: str) -> Distribution:
    """Parse the distribution of a sampled parameter (notation: `lathe_explore.sweep.space.Space`).

    Raises:
        InputError: there is no such distribution, or it has other arguments.
    """
    row = scenario.parameter(target)
    if row.is_list or row.type not in (int, float):
        raise InputError(f"{target}: drawn, and is {row.allowed()}; allowed: parameters that are one number")
    name, *words = told.split(":")
    if not is_law(told):
        name, words = "uniform", [name, *words]
    plain = [text for text in words if "=" not in text]
    pairs = [text.partition("=") for text in words if "=" in text]
    named = {key.strip(): number(scenario, target, text) for key, _, text in pairs}
    low, high = named.pop("min", -math.inf), named.pop("max", math.inf)
    log = name == "uniform" and plain[2:] == ["log"]
    law = (
        _of_two(scenario, target, told, name, plain[:2] if log else plain, log=log)
        if plain
        else _by_name(target, told, name, named)
    )
    whole = isinstance(law.dist, scipy.stats.rv_discrete)
    if row.type is int and not whole:
        raise InputError(f"{target}={shown(told)}; allowed: a discrete distribution, such as randint:low=1:high=5")
    if log:
        low, high = (math.log(end) if end > 0.0 else -math.inf for end in (low, high))
    first, last = float(law.cdf(math.nextafter(low, -math.inf))), float(law.cdf(high))
    if not last > first or not math.isfinite(law.ppf(0.5 * (first + last))):
        raise InputError(f"{target}={shown(told)}: not defined with these arguments; allowed: as scipy.stats.{name}")
    return Distribution(law, first, last, log, row.type is int)


def _of_two(scenario: Scenario, target: str, told: str, name: str, plain: list[str], *, log: bool) -> Any:
    """Return a uniform or normal distribution from its two arguments, or from the deviation of a normal one."""
    plain = ["100%", *plain] if name == "normal" and len(plain) == 1 else plain
    if len(plain) != 2 or name not in ("normal", "uniform"):
        raise InputError(f"{target}={shown(told)}; {_ALLOWED}")
    first, second = (number(scenario, target, text) for text in plain)
    if name == "normal":
        if not second > 0.0:
            raise InputError(f"{target}={shown(told)}; allowed: a deviation above 0")
        return scipy.stats.norm(first, second)
    if log:
        if not min(first, second) > 0.0:
            raise InputError(f"{target}={shown(told)}; allowed on a log range: ends above 0")
        first, second = math.log(first), math.log(second)
    return scipy.stats.uniform(first, second - first)


def _by_name(target: str, told: str, name: str, named: dict[str, float]) -> Any:
    """Return a distribution of SciPy with named arguments."""
    kind = _scipy_law(name)
    if kind is None:
        raise InputError(f"{target}={shown(told)}; {_ALLOWED}")
    shapes = kind.shapes.split(", ") if kind.shapes else []
    known = [*shapes, "loc", *(["scale"] if isinstance(kind, scipy.stats.rv_continuous) else [])]
    if not set(shapes) <= named.keys() <= set(known):
        raise InputError(
            f"{target}={shown(told)}; allowed: {':'.join([name, *(f'{each}=NUMBER' for each in shapes)])}, also "
            f"{', '.join(known[len(shapes) :])}, min and max"
        )
    return kind(**named)


def factor(names: Sequence[str], correlated: Mapping[str, float], sample: str) -> NDArray[np.float64] | None:
    """Return the Cholesky factor of a correlation matrix, shape (d, d); None without correlations.

    Args:
        names: the d sampled parameters.
        correlated: correlations by ``"NAME,NAME"``.
        sample: the sample, as of `lathe_explore.sweep.space.Space`.

    Raises:
        InputError: a name is unknown, the matrix is not positive definite, or the sample needs independent parameters.
    """
    if not correlated:
        return None
    matrix = np.eye(len(names))
    for pair, value in correlated.items():
        both = [each.strip() for each in pair.split(",")]
        if len(both) != 2 or len(set(both) & set(names)) != 2:
            raise InputError(f"correlation of {pair}; allowed: two of what is drawn: {', '.join(names)}")
        if not -1.0 < value < 1.0:
            raise InputError(f"correlation of {pair} = {value:g}; allowed: above -1 and below 1")
        one, other = (names.index(each) for each in both)
        matrix[one, other] = matrix[other, one] = value
    if sample.startswith("saltelli"):
        raise InputError(f"correlation of {pair} in a saltelli sample; allowed: sobol, halton, latin or random")
    try:
        return np.asarray(np.linalg.cholesky(matrix), np.float64)
    except np.linalg.LinAlgError:
        least = np.linalg.eigvalsh(matrix)[0]
        raise InputError(
            f"correlations of {', '.join(names)}: no distribution has them, since the least eigenvalue of their matrix "
            f"is {least:.3g}; allowed: a positive definite matrix (smaller correlations)"
        ) from None
