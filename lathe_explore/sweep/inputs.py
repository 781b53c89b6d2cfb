# SPDX-License-Identifier: Apache-2.0
"""Inputs of a sweep besides its parameters: third-party classes and files, each with a hash of its content.

All rows in a folder are computed with the same content of each input.
"""

import contextlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import xxhash

from lathe_explore.sweep.row import Measure
from lathe_explore.sweep.search_space import search_space
from lathe_explore.sweep.space import Space, axis
from lathe_rc.bag.provenance import origins_of
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario, content
from lathe_rc.errors import InputError
from lathe_rc.extensions import source_hash

Inputs = Mapping[str, str]  #: hash by ``package.module:Class`` or path

_SHOWN = 12  # displayed characters of a hash


def of_cell(scenario: Scenario, measures: Iterable[Measure] = ()) -> dict[str, str]:
    """Return the third-party classes of a cell, the files that it reads, and the functions that measure it."""
    found = {name: str(origin["source"]) for name, origin in origins_of(scenario.nodes).items()}
    found |= {each.name: source_hash(each.name.partition(":")[0]) for each in measures if not each.topic}
    for table in scenario.nodes.values():
        for row in type(table).rows().values():
            if row.is_path and (path := str(getattr(table, row.name))):
                found[path] = content(Path(path))
    return found


def names_inputs(scenario: Scenario, target: str) -> bool:
    """Return whether the values of a varied parameter name classes or files."""
    row = scenario.parameter(target)
    return row.is_path or row.named is not None or row.name == "stage"


def of_values(scenario: Scenario, values: Mapping[str, Value]) -> dict[str, str]:
    """Return the inputs of a cell with other values of parameters; none if the cell does not accept the values."""
    with contextlib.suppress(InputError):  # the row of such a cell has the reason
        return of_cell(scenario.varied(values))
    return {}


def of_spaces(scenario: Scenario, spaces: Iterable[Space], free: Mapping[str, str | Sequence[Value]]) -> dict[str, str]:
    """Return the inputs of a cell and of all its variations.

    Args:
        scenario: the cell.
        spaces: variations of a sweep, or plants and spindles of a tuning.
        free: search space of a tuning.
    """

    def values() -> Iterator[tuple[str, Value]]:
        for target, dimension in search_space(scenario, free).items() if free else ():
            yield from ((target, value) for value in dimension.ends)
        for space in spaces:
            for target, told in space.grid.items():
                if names_inputs(scenario, target):
                    yield from ((target, value) for value in axis(scenario, target, told))
            for cell in space.given:
                yield from ((target, value) for target, value in cell.items() if target not in space.carried)

    found = of_cell(scenario)
    for target, value in values():
        if names_inputs(scenario, target):
            found |= of_values(scenario, {target: value})
    return found


def changes(before: Inputs, now: Inputs) -> list[str]:
    """Return the inputs whose content has changed, one text per input."""
    return [
        f"{name} has the hash {now[name][:_SHOWN]} here, and {hashed[:_SHOWN]} in the rows"
        for name, hashed in before.items()
        if name in now and now[name] != hashed
    ]


def code(inputs: Inputs) -> str | None:
    """Return a hash of the third-party classes among inputs; None if there are none."""
    classes = sorted((name, hashed) for name, hashed in inputs.items() if _is_class(name))
    return f"xxh3:{xxhash.xxh3_128_hexdigest(repr(classes).encode())}" if classes else None


def check_here(inputs: Inputs) -> None:
    """Check on a worker that files and imported classes have the content of the client's ones.

    Raises:
        InputError: an input differs.
    """
    here = {name: _hash_here(name) for name in inputs if not _is_class(name) or name.partition(":")[0] in sys.modules}
    if differing := changes(inputs, here):
        raise InputError(f"a worker has other code or files: {differing[0]}; allowed: the same; start the worker anew")


@lru_cache(maxsize=256)
def _hash_here(name: str) -> str:
    return source_hash(name.partition(":")[0]) if _is_class(name) else content(Path(name))


def _is_class(name: str) -> bool:
    return ":" in name and not Path(name).is_absolute()
