# SPDX-License-Identifier: Apache-2.0
"""Tables for other libraries: pandas if installed, otherwise Arrow."""

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from lathe_rc.blocks.columns import TEXT, Column
from lathe_rc.messages import Samples

_SPINDLE = (Column("revolution", np.dtype(np.int64)), Column("spindle_angle", np.dtype(np.float64), "rad"))


def arrow_schema(columns: Sequence[Column], name: Callable[[Column], str]) -> Any:
    """Return the Arrow schema of a table, with the units as metadata of the fields."""
    return pa.schema(
        [
            pa.field(
                name(column),
                pa.string() if column.dtype == TEXT else pa.from_numpy_dtype(column.dtype),
                metadata={"unit": column.unit} if column.unit else None,
            )
            for column in columns
        ]
    )


def with_spindle(
    table: Sequence[Column], rows: Mapping[str, Samples], angle: Samples
) -> tuple[Sequence[Column], Mapping[str, Samples]]:
    """Insert the spindle's revolution and angle into a table, after the first two columns.

    Args:
        table: columns of the table.
        rows: values of the columns, shape (rows,), in the order of ``table``.
        angle: true angle of the spindle in each row [rad], shape (rows,).
    """
    turns = np.floor(angle / (2.0 * np.pi))
    spindle = {"revolution": turns.astype(np.int64) + 1, "spindle_angle": angle - 2.0 * np.pi * turns}
    first, fields = list(rows.items())[:2], list(rows.items())[2:]
    return (*table[:2], *_SPINDLE, *table[2:]), dict([*first, *spindle.items(), *fields])


def frame(topic: str, table: Sequence[Column], rows: Mapping[str, Samples]) -> Any:
    """Return a table as a ``pandas.DataFrame`` if pandas is installed, otherwise as a ``pyarrow.Table``.

    Args:
        topic: fully qualified topic.
        table: columns, including `time`.
        rows: values of the columns, shape (rows,).
    """
    if importlib.util.find_spec("pandas") is None:
        fields = arrow_schema(table, lambda column: column.name)
        return pa.Table.from_arrays([pa.array(rows[field.name], field.type) for field in fields], schema=fields)
    import pandas as pd

    made = pd.DataFrame(rows).set_index("time")
    made.attrs = {"topic": topic, "units": {column.name: column.unit for column in table if column.unit}}
    return made
