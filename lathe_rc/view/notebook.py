# SPDX-License-Identifier: Apache-2.0
"""Results, recordings and scenarios as HTML: what a notebook shows when one is the last line of a cell."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from lathe_rc import messages
from lathe_rc.analysis.metrology import turns_before
from lathe_rc.cell.columns import columns
from lathe_rc.cell.parameters import NodeParameters, Row, SharedParameters
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.scenario import Scenario

if TYPE_CHECKING:
    from lathe_rc.harness import Result

_LONGEST = 60  # characters of a value


def result(shown: "Result") -> str:
    """What came of a run, and the form error by revolution."""
    count, *errors = shown.recording.errors.told()
    rows = [("scenario", shown.scenario.name), ("host", shown.mode), ("length", f"{shown.simulated_s:.4g} s, {count}")]
    rows += [("form error", text.removeprefix("form error ")) for text in errors]
    rows += [("bag", str(shown.bag or "none"))]
    return _table((), rows) + _errors(shown.recording)


def recording(shown: Recording) -> str:
    """The topics, with their fields and units."""
    rows = []
    for topic, kind in shown.types.items():
        dense = topic in shown.dense
        count = shown.samples if dense else len(shown.sparse[topic].stamps)
        fields = ", ".join(column.label for column in columns(kind)[2:])
        rows.append((topic, f"{count} {'samples' if dense else 'messages'}", fields))
    return _table(("topic", "", "fields"), rows) + _errors(shown)


def scenario(shown: Scenario) -> str:
    """The nodes, and what is not at its default in each."""
    rows = [("all nodes", "", _changed(shown.shared, SharedParameters.rows().values()))] if shown.nodes else []
    for node, table in shown.nodes.items():
        own = [row for name, row in table.rows().items() if name not in SharedParameters.model_fields]
        rows.append((node, shown.kind(node) if table.stage else "", _changed(table, own)))
    return _table((shown.name, "kind", "other than default"), rows)


def _changed(table: SharedParameters | NodeParameters, rows: Iterable[Row]) -> str:
    """The parameters that are not at their defaults, in words."""
    told = []
    for row in rows:
        value = getattr(table, row.name)
        if value != row.default and row.name != "stage":
            text = Path(value).name if row.is_path else str(value)
            short = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"
            told.append(f"{row.name} = {short}" if row.unit == "1" else f"{row.name} = {short} {row.unit}")
    return ", ".join(told)


def _errors(shown: Recording) -> str:
    """The form error by revolution as a picture, if there is a revolution."""
    if not shown.errors.rms.size:
        return ""
    from lathe_rc.view import figure

    before = turns_before(shown.of_type(messages.ENCODER)["angle_true"])
    image = base64.b64encode(figure.png(figure.learning(shown.errors, before))).decode()
    return f'<img alt="form error by revolution" src="data:image/png;base64,{image}" />'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; the first cell of a row names it."""
    style = 'style="text-align: left"'
    lines = ["".join(f"<th {style}>{escape(text)}</th>" for text in head)] if head else []
    for name, *cells in rows:
        lines.append(f"<th {style}>{escape(name)}</th>" + "".join(f"<td {style}>{escape(text)}</td>" for text in cells))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
