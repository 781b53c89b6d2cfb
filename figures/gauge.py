# SPDX-License-Identifier: Apache-2.0
"""Prints the table of metrology.md: causes that the drive's sensor does not see."""

import json
import os
import tempfile
from pathlib import Path

from click.testing import CliRunner

from lathe_papers import cells
from lathe_rc import cli, harness

PARTS = 5
BLIND: cells.Values = {"controller": {"remap": []}}
SMALL: dict[str, object] = {
    "harmonic_order": [1, 2, 3, 4],
    "harmonic_amplitude": [19.8e-6, 222.75e-6, 14.85e-6, 19.8e-6],
}
RIGID = {"cut_elasticity": "rigid"}
CAUSES: dict[str, cells.Values] = {
    "deflection": {},
    "the same, run-out of 60 µm": {"loaded_drive": {"cut_run_out_amplitude": [60e-6, 5e-6]}},
    "the same, tool worn by 0.2 mm": {"loaded_drive": {"cut_wear": 0.2e-3}},
    "form programmed 1 % too small": {"loaded_drive": RIGID, "controller": SMALL},
    "none: noise alone": {"loaded_drive": RIGID},
}


def words(values: cells.Values) -> list[str]:
    """Changes of a scenario as `--set` takes them."""
    return [f"{node}.{name}={json.dumps(value)}" for node, table in values.items() for name, value in table.items()]


def run(values: cells.Values, **how: Path) -> float:
    """Largest form error of the last revolution [µm]."""
    return harness.run(cells.scenario.load("gauged", words(values)), **how).errors.largest[-1] * 1e6


def merged(*changes: cells.Values) -> cells.Values:
    """Changes of nodes, later ones on top."""
    return {node: {k: v for change in changes for k, v in change.get(node, {}).items()} for c in changes for node in c}


def parts(cause: cells.Values, node: str) -> list[float]:
    """Largest form error of parts that follow one another, each corrected from the record of the one before [µm]."""
    values, found = merged(cause, BLIND), []
    for part in range(1, PARTS + 1):
        found.append(run(values, bag=Path(f"part{part}")))
        arguments = ["correct", f"part{part}", "--scenario", "gauged", "--node", node, "-o", f"form{part + 1}.csv"]
        for each in words(values):
            arguments += ["--set", each]
        done = CliRunner().invoke(cli.main, arguments)
        assert done.exit_code == 0, done.output
        values = merged(values, {node: {"programmed_file": str(Path(f"form{part + 1}.csv").resolve())}})
    return found


columns = ["law learns from the gauge", *(f"part {k}" for k in range(1, PARTS + 1))]
print(f"| cause | {' | '.join(columns)} |\n| --- |{' ---: |' * len(columns)}")
for name, cause in CAUSES.items():
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        errors = [run(cause), *parts(cause, "controller" if "controller" in cause else "profile")]
        os.chdir("/")
    print(f"| {name} | {' | '.join(f'{error:.3g}' for error in errors)} |")
