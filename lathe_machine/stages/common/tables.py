# SPDX-License-Identifier: Apache-2.0
"""Composition of parameter tables with prefixes, and construction of objects from parameters by name."""

import inspect
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

from lathe_machine.plants.linear import Discretisation
from lathe_rc.cell.parameters import NodeParameters, parameter

R = TypeVar("R")
T = TypeVar("T", bound=NodeParameters)

_DERIVED = ("step", "step_ns", "nominal_speed")  # arguments that every table provides


@cache
def _sources(make: Callable[..., Any], table: type[NodeParameters], prefixes: tuple[str, ...]) -> dict[str, str]:
    """Return the name of the parameter for each argument of ``make`` that the table provides."""
    sources = {}
    for name in inspect.signature(make).parameters:
        known = [prefix + name for prefix in (*prefixes, "") if prefix + name in table.model_fields]
        if known or name in _DERIVED:
            sources[name] = known[0] if known else name
    return sources


def made_of(make: Callable[..., R], table: NodeParameters, *prefixes: str, **beside: Any) -> R:
    """Construct an object from the parameters of a table, matched to arguments by name.

    Args:
        make: class of the object, or a factory function.
        table: table with the parameters.
        prefixes: prefixes that parameter names may have before the names of arguments.
        beside: arguments given directly; they take precedence over parameters of the same name.
    """
    sources = _sources(make, type(table), prefixes)
    return make(**{name: getattr(table, sources[name]) for name in sources.keys() - beside.keys()}, **beside)


class ComposedParameters(NodeParameters):
    """Parameters combined from the tables of several elements; parameters in common appear only once."""

    discretisation: Discretisation = parameter("foh", "foh: exact for commands linear between samples; or tustin")

    def part(self, prefix: str, table: type[T]) -> T:
        """Return the table of an element, whose parameters have the prefix ``prefix``."""
        values = {name: getattr(self, prefix + name) for name in _own(table)}
        return table(**values, **{name: getattr(self, name) for name in _SHARED if name in table.model_fields})


_SHARED = tuple(ComposedParameters.model_fields)  # one value for all elements


def _own(table: type[NodeParameters]) -> list[str]:
    return [name for name in table.model_fields if name not in _SHARED]


def prefixed(prefix: str, table: type[NodeParameters]) -> dict[str, Any]:
    """Return the parameters of an element under their prefixed names, as fields for a pydantic model."""
    fields = table.model_fields
    return {prefix + name: (fields[name].annotation, fields[name]) for name in _own(table)}
