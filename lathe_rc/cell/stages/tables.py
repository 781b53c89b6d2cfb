# SPDX-License-Identifier: Apache-2.0
"""Tables of parameters: of parts under a prefix, and what is made of a table by the names of its parameters."""

import inspect
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.plants.linear import Discretisation

R = TypeVar("R")
T = TypeVar("T", bound=NodeParameters)

_DERIVED = ("step", "step_ns", "nominal_speed")  # of every table


@cache
def _sources(make: Callable[..., Any], table: type[NodeParameters], prefixes: tuple[str, ...]) -> dict[str, str]:
    """The parameter that gives each argument of ``make``, of those that the table has."""
    sources = {}
    for name in inspect.signature(make).parameters:
        known = [prefix + name for prefix in (*prefixes, "") if prefix + name in table.model_fields]
        if known or name in _DERIVED:
            sources[name] = known[0] if known else name
    return sources


def made_of(make: Callable[..., R], table: NodeParameters, *prefixes: str, **beside: Any) -> R:
    """An object whose arguments are parameters of a table, by their names.

    Args:
        make: its class, or a function.
        table: with the parameters.
        prefixes: that parameters may have before the names of arguments.
        beside: arguments that are something else; they come before the parameters of their names.
    """
    sources = _sources(make, type(table), prefixes)
    return make(**{name: getattr(table, sources[name]) for name in sources.keys() - beside.keys()}, **beside)


class ComposedParameters(NodeParameters):
    """Parameters that the parts share."""

    discretisation: Discretisation = parameter("foh", "foh: exact for commands linear between samples; or tustin")

    def part(self, prefix: str, table: type[T]) -> T:
        """The table of a part, whose parameters stand under ``prefix``."""
        values = {name: getattr(self, prefix + name) for name in _own(table)}
        return table(**values, **{name: getattr(self, name) for name in _SHARED if name in table.model_fields})


_SHARED = tuple(ComposedParameters.model_fields)  # one value for all parts


def _own(table: type[NodeParameters]) -> list[str]:
    return [name for name in table.model_fields if name not in _SHARED]


def prefixed(prefix: str, table: type[NodeParameters]) -> dict[str, Any]:
    """The parameters of a part under their names in the whole, as pydantic makes a model of them."""
    fields = table.model_fields
    return {prefix + name: (fields[name].annotation, fields[name]) for name in _own(table)}
