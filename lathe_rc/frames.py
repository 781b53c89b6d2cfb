# SPDX-License-Identifier: Apache-2.0
"""Signals as tables of other libraries: pandas where it is installed, otherwise Arrow."""

import importlib.util
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from lathe_rc import messages
from lathe_rc.bag.exporting.formats import arrow_schema
from lathe_rc.cell.columns import Column, columns, dense_rows, sparse_rows
from lathe_rc.cell.recording import Recording
from lathe_rc.errors import InputError
from lathe_rc.messages import Samples, full

_SPINDLE = (Column("revolution", np.dtype(np.int64)), Column("spindle_angle", np.dtype(np.float64), "rad"))


def frame(recording: Recording, topic: str) -> Any:
    """A topic as a table: a row a sample, or a message; of a message with lists, a row an element.

    The columns are those of `lathe_rc.bag.exporting.export`: ``sample``, ``time`` [s] (sample 0 is at 1 s) and the
    fields of the message. With an encoder in the recording two come before the fields: ``revolution``, counted from 1,
    and ``spindle_angle``, the true angle in it [rad].

    Args:
        recording: of a run.
        topic: with or without the leading slash.

    Returns:
        Where pandas is installed, a ``pandas.DataFrame`` with a copy of the samples, ``time`` as its index, and the
        topic and the unit of each column that has one in ``attrs``. Otherwise a ``pyarrow.Table``, whose fields have
        the unit in their metadata, as in a Parquet file of an export.

    Raises:
        InputError: there is no such topic.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import frames, harness, resources
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=3"])
        >>> recording = harness.run(piston).recording
        >>> tool = frames.frame(recording, "/tool")  # the same as recording.frame("/tool")
        >>> (tool["error"].abs() * 1e6).groupby(tool["revolution"]).max().round(1).to_dict()
        {1: 232.7, 2: 13.4, 3: 4.0}
        >>> tool.attrs["units"]["error"]
        'm'
    """
    table, rows = _table(recording, topic)
    if importlib.util.find_spec("pandas") is None:
        fields = arrow_schema(table, lambda column: column.name)
        return pa.Table.from_arrays([pa.array(rows[field.name], field.type) for field in fields], schema=fields)
    import pandas as pd

    made = pd.DataFrame(rows).set_index("time")
    made.attrs = {"topic": full(topic), "units": {column.name: column.unit for column in table if column.unit}}
    return made


def _table(recording: Recording, topic: str) -> tuple[Sequence[Column], Mapping[str, Samples]]:
    """Columns of a topic and their values, shape (rows,), in this order."""
    name = full(topic)
    if name not in recording.types:
        raise InputError(f"no topic {topic!r} in the recording; allowed: {', '.join(recording.types)}")
    table = columns(recording.types[name])
    if name in recording.dense:
        rows = dense_rows(recording.first, recording.dense[name], recording.step_ns)
    else:
        rows = sparse_rows(table, recording.messages(name), recording.step_ns)
    if messages.ENCODER not in {recording.types[known] for known in recording.dense}:
        return table, rows
    angle = recording.of_type(messages.ENCODER)["angle_true"][rows["sample"] - recording.first]
    turns = np.floor(angle / (2.0 * np.pi))
    spindle = {"revolution": turns.astype(np.int64) + 1, "spindle_angle": angle - 2.0 * np.pi * turns}
    first, fields = list(rows.items())[:2], list(rows.items())[2:]
    return (*table[:2], *_SPINDLE, *table[2:]), dict([*first, *spindle.items(), *fields])
