# SPDX-License-Identifier: Apache-2.0
"""Tables of stages that compute what others compute alone: their parameters stand under a prefix."""

from typing import Any, TypeVar

from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.plants.linear import Discretisation

T = TypeVar("T", bound=NodeParameters)


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
