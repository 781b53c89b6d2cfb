# SPDX-License-Identifier: Apache-2.0
"""Bags of a run: of the whole run, and of sections of it."""

from pathlib import Path

from lathe_rc.cell.scenario import Scenario


def of_whole(scenario: Scenario, bag: Path | None) -> Path | None:
    """Return the bag of the whole run; None if only snapshots or nothing was recorded."""
    return None if scenario.recorder[1].mode == "snapshot" else bag


def snapshots_in(folder: Path | None) -> list[Path]:
    """Return the snapshots in a folder, in the order of their triggers."""
    return sorted(folder.iterdir()) if folder is not None and folder.is_dir() else []
