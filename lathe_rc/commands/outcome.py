# SPDX-License-Identifier: Apache-2.0
"""Result of a run as tables and lines for the terminal."""

from collections.abc import Callable, Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from lathe_rc import harness
from lathe_rc.analysis.budget import Budget, Share
from lathe_rc.analysis.metrology import Lay
from lathe_rc.commands import plot, tables
from lathe_rc.judge import part
from lathe_rc.judge.loops import LoopResult

_MOST_EVENTS = 12  # rows of the event table
_ALIKE = 4  # length of a series of similar events from which its inner events are left out


def table(result: harness.Result) -> Table:
    """Return a table of the part's form error in its first and last revolution."""
    columns = {"rms": "RMS [µm]", "max": "maximum [µm]", "peak_to_valley": "peak to valley [µm]", "ront": "RONt [µm]"}
    return _ends("", columns, lambda revolution: part.numbers(result.part, revolution))


def _loop(node: str, loop: LoopResult) -> Table:
    """Return a table of a loop's error in its first and last revolution."""
    columns = {"rms": "RMS", "max": "maximum", "peak_to_valley": "peak to valley", "mean": "mean"}
    return _ends(f"{node} [{loop.loop.quantity.unit}]", columns, loop.row)


def _ends(heading: str, columns: Mapping[str, str], numbers: Callable[[int], Mapping[str, Any]]) -> Table:
    found = tables.table(heading, *columns.values(), left=1)
    for label, revolution in (("first revolution", 0), ("last revolution", -1)):
        row = numbers(revolution)
        found.add_row(label, *(f"{row[name]:#.4g}" for name in columns))
    return found


def _events(result: harness.Result) -> Table:
    """Return a table of the event log, limited in length; a series of similar events is shortened to its ends."""
    table = tables.table("time [s]", "topic", "what happened", left=3, overflow="fold")
    table.columns[0].justify = "right"
    step, rows = result.scenario.shared.step, list[tuple[str, str, str]]()
    for _, run in groupby(result.event_log, lambda found: (found.topic, found.text.partition(":")[0])):
        alike = [(f"{found.sample * step:.6g}", found.topic, found.text) for found in run]
        rows += alike if len(alike) < _ALIKE else [alike[0], ("", "", f"{len(alike) - 2} more of the kind"), alike[-1]]
    if (left := len(rows) - _MOST_EVENTS) > 0:
        rows[_MOST_EVENTS:] = [("", "", f"and {left} more: see --json, or the bag's report")]
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def facts(result: harness.Result) -> list[str]:
    """Return one line each on error growth, tolerance, blocks, pace and rejected messages."""
    refused = [f"{count} messages refused from {sender}" for sender, count in result.refused.items()]
    surface, first, step = result.surface, result.recording.first, result.scenario.shared.step
    return [
        *(each.told() for each in (result.growth, result.verdict) if each),
        *filter(None, [result.recording.sound_form[1] if not result.verdict else ""]),
        *(
            f"{node}: {text}"
            for node, loop in result.loops.items()
            for text in (*(text for text, _ in loop.judged()), *loop.behaviour())
        ),
        *_margins(result),
        *([part.along_in_words(surface) if isinstance(surface, Lay) else surface] if surface else []),
        *([f"gone on from sample {first}, {first * step:.4g} s"] if first else []),
        f"{result.blocks} blocks sent, {result.dropped} lost; {result.recording.revolutions} revolutions",
        f"{result.simulated_s:.2f} s simulated in {result.wall_s:.2f} s: {result.real_time_factor:.1f}x real time",
        *(result.lateness.lines() if result.lateness else []),
        *refused,
    ]


def _margins(result: harness.Result) -> list[str]:
    """Return stability margins and drive margins of all learning controllers, one line each."""
    margins = [
        f"{name} {'not known' if margin is None else f'{margin:.4g}'}" for name, margin in result.margins.items()
    ]
    drives = [f"{name} {margin}" for name, margin in result.drive_margins.items()]
    lines = {"stability margin": margins, "drive margin": drives}
    return [f"{name}: {', '.join(each)}" for name, each in lines.items() if each]


def budget_told(found: Budget) -> Iterator[RenderableType]:
    """Yield an error budget, one row per cause."""
    whole = Share(f"form error, {found.revolutions} revolutions", 1.0, found.rms, found.largest)
    columns: dict[str, Callable[[Share], str]] = {
        "cause": lambda each: each.name,
        "share of the power [%]": Share.percent,
        "RMS [µm]": lambda each: f"{each.rms * 1e6:.3g}",
        "maximum [µm]": lambda each: f"{each.largest * 1e6:.3g}",
    }
    yield tables.of_rows((*found.rows, whole), columns, left=1)
    yield from (Text(f"not switched off: {name}: {why}") for name, why in found.left_out.items())
    yield from (Text(warning) for warning in filter(None, [found.warning]))


def told(
    result: harness.Result, further: Mapping[str, Path], *, note: str = "", budget: Budget | None = None
) -> Iterator[RenderableType]:
    """Yield the result of a run: part, events, facts, budget and files; ``note``: an additional line."""
    if result.errors.rms.size:
        yield table(result)
        yield from plot.shown(result, tables.console())
    for node, loop in result.loops.items():
        if loop.found.errors.rms.size:
            yield _loop(node, loop)
    if result.event_log:
        yield _events(result)
    yield from map(Text, [*facts(result), *filter(None, [note])])
    if budget is not None:
        yield from budget_told(budget)
    files = [("bag", result.bag), *(("snapshot", path) for path in result.snapshots), *further.items()]
    yield from (f"{name}: {path}" for name, path in files if path)
