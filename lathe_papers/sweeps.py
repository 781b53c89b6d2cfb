# SPDX-License-Identifier: Apache-2.0
"""Sweeps for studies, computed on all cores with a study's progress display."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lathe_explore
from lathe_rc.cell.scenario import Scenario
from lathe_rc.study import Track

if TYPE_CHECKING:
    import pyarrow as pa

    from lathe_explore.sweep.space import Space


def table(
    asked: Sequence[tuple[str, Scenario, "Space"]], folder: str, columns: Sequence[str], track: Track, **options: Any
) -> "list[pa.Table]":
    """Run several sweeps and return the requested columns of their rows, one table per sweep.

    Args:
        asked: name, scenario and space of each sweep; sweeps with the same name share a folder.
        folder: parent folder of the sweep folders; empty to discard the rows.
        columns: columns to read; a target that a sweep does not vary has the scenario's value.
        track: progress display, in cells.
        options: further arguments of `lathe_explore.run_sweep`.
    """
    from lathe_explore.sweep.workers import client_of

    count = sum(space.count(scenario) for _, scenario, space in asked)
    steps = iter(track(range(count)))

    def watch(event: Mapping[str, Any]) -> None:
        come = event["statuses"].total() if event["event"] == "rows" else event.get("computed", 0)
        for _ in range(come):
            next(steps, None)

    with tempfile.TemporaryDirectory() as temporary, client_of(None, None) as client:
        place = Path(folder or temporary)
        found = []
        for name, scenario, space in asked:
            swept = lathe_explore.run_sweep(scenario, space, place / name, client=client, watch=watch, **options)
            found.append(swept.table().select([name for name in columns if name in swept.folder.schema.names]))
        list(steps)
        return found
