# SPDX-License-Identifier: Apache-2.0
"""Parameters that are in their limits, and so far from what a machine has that floating point cannot carry them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.errors import InputError

_FAR = 1e9  # times the default, or the same part of it
_HUGE = 1e12  # where the default is 0


@contextmanager
def refused(tables: Mapping[str, NodeParameters]) -> Iterator[None]:
    """Turn a failure of floating point into a refusal of the parameters that are far from their defaults.

    Args:
        tables: of the nodes that are made or checked, by name.

    Raises:
        InputError: numbers became too large or too small, and a parameter is the cause.
    """
    try:
        yield
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        far = [each for name, table in tables.items() for each in _far(name, table)]
        if not far:
            raise
        told = f"{'; '.join(far)}: nothing can be computed with that ({error.args[-1]}); take what a machine has"
        raise InputError(told) from None


def _far(name: str, table: NodeParameters) -> Iterator[str]:
    for row in type(table).rows().values():
        value = getattr(table, row.name)
        if row.type is not float or row.is_list or not value or not isinstance(row.default, float):
            continue
        size, usual = abs(value), abs(row.default)
        if not (usual / _FAR < size < usual * _FAR if usual else size < _HUGE):
            unit = f" [{row.unit}]" if row.unit else ""
            yield f"{name}.{row.name} = {value:g}{unit} (default {row.default:g})"
