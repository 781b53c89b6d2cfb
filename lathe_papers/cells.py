# SPDX-License-Identifier: Apache-2.0
"""Runs of the scenarios of ``config/`` with changed parameters."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

from lathe_rc import harness
from lathe_rc.cell import batch, scenario
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError
from lathe_rc.study import Track

Values = Mapping[str, object]
K = TypeVar("K")


def _yaml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value).replace("'", '"') if isinstance(value, list) else str(value)


def load(name: str, shared: Values | None = None, **nodes: Values) -> Scenario:
    """Load a scenario of ``config/`` with shared and node parameters replaced."""
    changes = [f"{parameter}={_yaml(value)}" for parameter, value in (shared or {}).items()]
    changes += [f"{node}.{parameter}={_yaml(v)}" for node, table in nodes.items() for parameter, v in table.items()]
    return scenario.load(name, changes)


def run(name: str, shared: Values | None = None, **nodes: Values) -> harness.Result:
    """Run a scenario of ``config/`` offline, with the same replacements as `load`."""
    return harness.run(load(name, shared, **nodes))


def kept(made: Sequence[Scenario], keep: batch.Make[K], track: Track) -> Iterator[K | None]:
    """Run many scenarios; yield each keeper's result in order, or None for a failed run.

    Raises:
        InputError: a scenario is invalid.
    """
    outcomes = batch.run_many(made, keep)
    for _ in track(range(len(made))):
        outcome = next(outcomes)
        if isinstance(outcome.error, InputError):
            raise outcome.error
        yield outcome.kept
