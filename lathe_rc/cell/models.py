# SPDX-License-Identifier: Apache-2.0
"""Controllers' models of drive, form and encoder, taken from the nodes unless the scenario gives others.

If a parameter that `lathe_rc.cell.parameters.parameter` marks with a drive quantity is not set, its value is that of
the drive that reads the controller's command. Quantities with the same word before a dot belong together: a scenario
gives all of them or none. The parameters that a table ``asks`` for are provided in the same way by the node that has
them.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import cast

from lathe_rc.cell.parameters import NodeParameters, Value, remapped
from lathe_rc.errors import InputError

Quantity = float | list[float]


@cache
def _marked(table: type[NodeParameters]) -> Mapping[str, str]:
    """Return the drive quantity by parameter."""
    return {name: row.drive for name, row in table.rows().items() if row.drive}


def _together(quantity: str) -> str:
    """Return the group of a quantity, or the quantity itself if it has no group."""
    return quantity.partition(".")[0]


def _not_given(table: NodeParameters) -> Mapping[str, str]:
    """Return the drive quantity by parameter, for the parameters that the scenario does not give."""
    marked = _marked(type(table))
    given = {_together(quantity) for name, quantity in marked.items() if name in table.model_fields_set}
    return {name: quantity for name, quantity in marked.items() if _together(quantity) not in given}


def _drives(tables: Mapping[str, NodeParameters], topic: str) -> Iterator[tuple[str, Mapping[str, Quantity]]]:
    """Yield the names and quantities of the drives that read a topic."""
    for node, table in tables.items():
        for command, known in table.drive_models().items():
            if remapped(table, command) == topic:
                yield node, known


def _model(node: str, table: NodeParameters, tables: Mapping[str, NodeParameters]) -> dict[str, Quantity]:
    """Return the commanded drives' values for the parameters that the scenario does not give."""
    values: dict[str, Quantity] = {}
    of: dict[str, str] = {}
    missing = _not_given(table)
    for drive, known in _drives(tables, remapped(table, table.commanded_topic)) if missing else ():
        for name, quantity in missing.items():
            if quantity in known and values.setdefault(name, known[quantity]) != known[quantity]:
                raise InputError(
                    f"{node}.{name} is not given, and the drives that {node} commands differ: {of[name]} has "
                    f"{values[name]}, {drive} {known[quantity]}; allowed: to give it"
                )
            of.setdefault(name, drive)
    rows = type(table).rows()
    return {name: values.get(name, cast("Quantity", rows[name].default)) for name in missing}


def _known(node: str, table: NodeParameters, tables: Mapping[str, NodeParameters]) -> dict[str, Value]:
    """Return other nodes' values for the parameters that a table asks for and the scenario does not give."""
    values: dict[str, Value] = {}
    for names in table.asks:
        if names & table.model_fields_set:
            continue
        told = {other: known for other, each in tables.items() if names <= (known := each.known()).keys()}
        first, *others = [*told] or [""]
        for other in others:
            if differing := sorted(name for name in names if told[other][name] != told[first][name]):
                raise InputError(
                    f"{node}.{differing[0]} is not given, and {first} and {other} differ in it; allowed: to give it"
                )
        values |= {name: told[first][name] for name in names} if first else {}
    return values


def follows(table: NodeParameters, name: str) -> bool:
    """Return whether a parameter that the scenario does not give can take its value from other nodes."""
    return name in _not_given(table) or any(
        name in names and not names & table.model_fields_set for names in table.asks
    )


def given(table: NodeParameters) -> NodeParameters:
    """Return a copy of a table, in which the models count as given."""
    made = table.model_copy()
    made.model_fields_set.update(_marked(type(table)))
    return made


def resolved(tables: Mapping[str, NodeParameters]) -> dict[str, NodeParameters]:
    """Return the tables of a cell by node, with the missing models filled in; these models count as not given.

    Raises:
        InputError: several drives are commanded, and a missing model cannot match all of them.
    """
    made = dict(tables)
    for node, table in tables.items():
        values: dict[str, Value] = {**_model(node, table, tables), **_known(node, table, tables)}
        if any(getattr(table, name) != value for name, value in values.items()):
            made[node] = table.model_copy(update=values)
            # These values still count as not given: another drive in a variation changes them again.
            made[node].model_fields_set.difference_update(values)
    return made


def of_drives(node: str, tables: Mapping[str, NodeParameters]) -> dict[str, Quantity]:
    """Return the default model of a node by parameter, ignoring the values given in the scenario.

    Raises:
        InputError: see `resolved`.
    """
    bare = tables[node].model_copy()
    bare.model_fields_set.difference_update(_marked(type(bare)))
    return _model(node, bare, {**tables, node: bare})
