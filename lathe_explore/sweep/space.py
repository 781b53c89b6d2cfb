# SPDX-License-Identifier: Apache-2.0
"""Variations of a cell: grids, lists, samples, derived parameters and seeds.

    space = Space(
        grid={"learning_controller.lead_time": "1.3e-3:1.5e-3:9"},
        sampled={"electrodynamic_actuator.damping": "normal:5%"},
        sample="sobol:512",
    )
    for values in space.cells(scenario):
        ...

The cells are the product of the given cells, the grids, the sample points and the seeds, in this order: the seeds vary
fastest, then the points, then the values of the last grid. Each of them is given as a string, as on the command line,
or as values, see `Space`.
"""

import itertools
import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from lathe_explore.sweep.distributions import drawn, factor, number
from lathe_explore.sweep.expression import Formulas, ordered
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import ParameterRow, Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, shown

SAMPLERS = ("sobol", "halton", "latin", "random", "saltelli")
_MOST_POINTS = 2**24
_SAMPLES = f"sobol:N, halton:N, latin:N, random:N or saltelli:N, N from 1 up to {_MOST_POINTS}"
_PIECE = 2**12  # number of sample points drawn at a time
_LONG = 40  # number of characters of an axis that a message quotes


@dataclass(frozen=True)
class Space:
    """Variations of a cell.

    Targets are ``NODE.PARAM``, ``NODE.PARAM[K]`` for an element of a list, or ``PARAM`` for a shared parameter. A
    number that ends in ``%`` is a percentage of the scenario's value.

    Attributes:
        grid: values by target: a list, or a string: ``LOW:HIGH:COUNT`` (ends included), ``LOW:HIGH:COUNT:log``, or
            values separated by commas.
        sampled: distributions by target, with one value per sample point: ``LOW:HIGH``, ``LOW:HIGH:log``,
            ``uniform:LOW:HIGH``, ``normal:MEAN:DEVIATION``, ``normal:DEVIATION`` about the scenario's value, or a
            distribution of `scipy.stats` with its arguments, such as ``weibull_min:c=1.5:scale=3e-3``; each can be
            truncated: ``:min=LOW``, ``:max=HIGH``.
        correlated: correlations of sampled parameters, by ``"TARGET,TARGET"``: those of the normally distributed
            quantities whose quantiles the parameters have (Gaussian copula).
        ties: formulas of derived parameters by target, such as ``fine_controller.q_time * 1.1``: targets with
            + - * / **, brackets and functions, see `lathe_explore.sweep.expression`.
        sample: ``sobol:N``, ``halton:N``, ``latin:N`` or ``random:N``; ``saltelli:N`` for N (d + 2) points of d
            parameters, of which pairs differ in one parameter alone; empty if nothing is sampled.
        seeds: number of seeds per combination of the other values, starting at the scenario's seed.
        given: individual cells, each as values by target.
        carried: columns of ``given`` that are no parameters but go into the rows, as text.
        sample_seed: random seed of the sample.

    Example:
        >>> import lathe_explore
        >>> import lathe_rc
        >>> lead = "learning_controller.lead_time"
        >>> space = lathe_explore.Space(grid={lead: "1e-3:2e-3:5"}, sampled={"tool.feed": "80%:120%"}, sample="sobol:8")
        >>> space.count(lathe_rc.load("piston"))
        40
    """

    grid: Mapping[str, str | Sequence[Value]] = field(default_factory=dict)
    sampled: Mapping[str, str] = field(default_factory=dict)
    correlated: Mapping[str, float] = field(default_factory=dict)
    ties: Mapping[str, str] = field(default_factory=dict)
    sample: str = ""
    seeds: int = 1
    given: Sequence[Mapping[str, Value]] = ()
    carried: Sequence[str] = ()
    sample_seed: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return the arguments for ``Space(**arguments)`` that reproduce this space."""
        return cast("dict[str, Any]", json.loads(json.dumps(asdict(self), default=list)))

    def targets(self) -> list[str]:
        """Return the parameters that differ between the cells, in column order."""
        seed = ["seed"] if self.seeds > 1 else []
        named = [name for cell in self.given for name in cell if name not in self.carried]
        return list(dict.fromkeys([*named, *self.grid, *self.sampled, *self.ties, *seed]))

    def count(self, scenario: Scenario) -> int:
        """Return the number of cells that the space has for a scenario."""
        axes = [len(axis(scenario, target, told)) for target, told in self.grid.items()]
        return math.prod(axes) * max(self._points(), 1) * max(len(self.given), 1) * self.seeds

    def check(self, scenario: Scenario) -> None:
        """Check before any computation that the space is valid for a scenario.

        Raises:
            InputError: the space is invalid; the message names the target, the value and the allowed values.
        """
        twice = [target for target in self.grid if target in self.sampled or target in self.ties]
        twice += [target for target in self.sampled if target in self.ties]
        if twice:
            raise InputError(f"{twice[0]}: varied, drawn or tied twice; allowed: once")
        check_distinct(self.targets())
        if self.seeds < 1:
            raise InputError(f"seeds = {self.seeds}; allowed: from 1")
        for target in self.targets():
            scenario.parameter(target)
        for place, cell in enumerate(self.given, 1):
            if missing := [name for name in self.carried if name not in cell]:
                raise InputError(f"{missing[0]}: no column of the given cells; allowed: {', '.join(cell)}")
            for target in cell.keys() - set(self.carried):
                try:
                    _check_type(target, scenario.parameter(target), cell[target])
                except InputError as error:
                    raise InputError(f"row {place} of the given cells: {error}") from None
        if any(dict(first) == dict(second) for first, second in itertools.pairwise(sorted(self.given, key=canonical))):
            raise InputError("two of the given cells are the same; allowed: each once")
        if self.sampled and not self.sample:
            raise InputError(f"{next(iter(self.sampled))}: drawn, and no sample says how often; allowed: {_SAMPLES}")
        if self.sample and not self.sampled:
            raise InputError(f"sample {self.sample!r}, and nothing is drawn; allowed: LOW:HIGH or a law for a target")
        self._points()
        for target, told in self.sampled.items():
            drawn(scenario, target, told)
        factor(list(self.sampled), self.correlated, self.sample)
        ordered(self.ties)
        next(self.cells(scenario))  # evaluates the formulas once; most errors show in the first cell

    def cells(self, scenario: Scenario) -> Iterator[dict[str, Value]]:
        """Yield the varied values of each cell, by target."""
        axes = {target: axis(scenario, target, told) for target, told in self.grid.items()}
        first_seed = scenario.shared.seed
        formulas = Formulas(scenario, self.ties)
        rows = {name: scenario.parameter(name) for cell in self.given for name in cell if name not in self.carried}
        for cell in self.given or ({},):
            given = {name: _plain(rows[name], value) if name in rows else value for name, value in cell.items()}
            for combination in itertools.product(*axes.values()):
                fixed = {**given, **dict(zip(axes, combination, strict=True))}
                for point in self._draws(scenario):
                    for seed in range(self.seeds):
                        values = {**fixed, **point}
                        if self.seeds > 1:
                            values["seed"] = first_seed + seed
                        yield formulas.add_to(values)

    def _points(self) -> int:
        """Return the number of sample points; 0 without a sample."""
        if not self.sample:
            return 0
        name, _, number = self.sample.partition(":")
        count = int(number) if number.isascii() and number.isdigit() else 0
        if name not in SAMPLERS or not 0 < count <= _MOST_POINTS:
            raise InputError(f"sample {self.sample!r}; allowed: {_SAMPLES}")
        return count * (len(self.sampled) + 2) if name == "saltelli" else count

    def _draws(self, scenario: Scenario) -> Iterator[dict[str, Value]]:
        """Yield the sampled values of each point, by target."""
        if not self.sampled:
            yield {}
            return
        laws = {target: drawn(scenario, target, told) for target, told in self.sampled.items()}
        mixed, normal = factor(list(laws), self.correlated, self.sample), scipy.stats.norm
        for quantiles in _sample(self.sample.partition(":")[0], self._points(), len(laws), self.sample_seed):
            points = quantiles if mixed is None else normal.cdf(normal.ppf(quantiles) @ mixed.T)
            columns = [law.at(column) for law, column in zip(laws.values(), points.T, strict=True)]
            for row in zip(*columns, strict=True):
                yield dict(zip(laws, row, strict=True))


def _sample(name: str, count: int, dimensions: int, seed: int) -> Iterator[NDArray[np.float64]]:
    """Yield points in the unit cube, shape (n, dimensions); a larger sample starts with the points of a smaller one."""
    if name == "saltelli":  # Saltelli et al. 2010: A, B, and A with one column of B; a larger sample adds such groups
        for pairs in _sample("sobol", count // (dimensions + 2), 2 * dimensions, seed):
            one, other = pairs[:, None, :dimensions], pairs[:, None, dimensions:]
            mixed = np.where(np.eye(dimensions, dtype=bool), other, one)
            yield np.concatenate([one, other, mixed], axis=1).reshape(-1, dimensions)
        return
    if name == "latin":  # all points at once, because they depend on the count
        yield scipy.stats.qmc.LatinHypercube(dimensions, rng=seed).random(count)
        return
    generator = np.random.default_rng(seed)
    draws: dict[str, Callable[[int], NDArray[np.float64]]] = {
        "sobol": scipy.stats.qmc.Sobol(dimensions, rng=seed).random,
        "halton": scipy.stats.qmc.Halton(dimensions, rng=seed).random,
        "random": lambda count: generator.random((count, dimensions)),
    }
    for first in range(0, count, _PIECE):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Sobol warns about counts that are not a power of two
            piece = draws[name](min(_PIECE, count - first))
        yield piece


def axis(scenario: Scenario, target: str, told: str | Sequence[Value]) -> Sequence[Value]:
    """Return the distinct values of a grid axis.

    Raises:
        InputError: a string cannot be parsed, or a value is invalid for the parameter.
    """
    row = scenario.parameter(target)
    if isinstance(told, str):
        found = _told(scenario, target, told)
    else:
        found = [_value(scenario, target, row, each) if isinstance(each, str) else each for each in told]
    for value in found:
        _check_type(target, row, value)
    if not found:
        raise InputError(f"{target}: no value; allowed: one or more")
    return list({canonical({target: value}): value for value in (_plain(row, each) for each in found)}.values())


def _told(scenario: Scenario, target: str, told: str) -> Sequence[Value]:
    row = scenario.parameter(target)
    parts = told.split(":")
    if row.is_list or row.type not in (int, float) or len(parts) == 1:
        return [_value(scenario, target, row, text) for text in _split(told)]
    log = parts[3:] == ["log"]
    if len(parts) not in (3, 4) or (len(parts) == 4 and not log) or not parts[2].strip().isdigit() or int(parts[2]) < 1:
        raise InputError(
            f"{target}={shown(told)}; allowed: LOW:HIGH:COUNT, LOW:HIGH:COUNT:log, or values between commas"
        )
    low, high = (number(scenario, target, text) for text in parts[:2])
    if log and not min(low, high) > 0.0:
        raise InputError(f"{target}={shown(told)}; allowed on a log range: ends above 0")
    count = int(parts[2])
    found: list[Value] = (np.geomspace(low, high, count) if log else np.linspace(low, high, count)).tolist()
    if row.type is int:
        if any(value != round(cast("float", value)) for value in found):
            few = ", ".join(f"{value:g}" for value in found)[:_LONG]
            raise InputError(f"{target}={shown(told)} gives {few}; allowed: whole numbers")
        found = [round(cast("float", value)) for value in found]
    return found


def _split(text: str) -> list[str]:
    """Split a string at commas outside brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        quote = ("" if letter == quote else quote) if quote else (letter if letter in "'\"" else "")
        depth += (letter in "[(") - (letter in "])") if not quote else 0
        if letter == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _value(scenario: Scenario, target: str, row: ParameterRow, text: str) -> Value:
    if not row.is_list and row.type is str:
        return text.strip("'\"")
    if not row.is_list and row.type in (int, float) and text.endswith("%"):
        found = number(scenario, target, text)
        return found if row.type is float else round(found)
    return ros_yaml.parse_value(text, target)


def check_distinct(targets: Sequence[str]) -> None:
    """Reject two targets that set the same parameter: of a list and an element, or of all nodes and one node.

    Raises:
        InputError: there are two such targets.
    """
    for one, other in itertools.permutations(targets, 2):
        whole = other.partition("[")[0].strip()
        if one in (whole, whole.rpartition(".")[2]):
            raise InputError(f"{one} and {other} set the same parameter; allowed: one of them")


def _plain(row: ParameterRow, value: Value) -> Value:
    """Return a value in its parameter's type: 1 for a real number is 1.0, so that both are the same cell."""
    if row.type is not float:
        return value
    return [float(item) for item in value] if isinstance(value, list) else float(cast("float", value))


def _check_type(target: str, row: ParameterRow, value: Value) -> None:
    """Reject a value of the wrong type; a value out of range becomes an error in its cell's row."""
    kinds = (int, float) if row.type is float else row.type
    items = value if isinstance(value, list) else [value]
    wrong = [item for item in items if not isinstance(item, kinds) or (row.type is not bool and isinstance(item, bool))]
    wrong += [item for item in items if row.choices and not row.named and item not in row.choices]
    if wrong or row.is_list != isinstance(value, list):
        raise InputError(f"{target} = {shown(repr(value))}; allowed: {row.allowed()}")


def canonical(values: Mapping[str, Value]) -> str:
    """Return a canonical string of values, independent of their order."""
    return json.dumps(dict(values), sort_keys=True)
