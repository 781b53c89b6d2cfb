# SPDX-License-Identifier: Apache-2.0
"""What a killed recorder loses: kill -9 at random moments of the piston, one process a node, everything recorded.

python benchmarks/crash.py [KILLS]

Lost is the wall time between two moments: when the cell had heard that the recorder had taken the last sample that is
in the bag, and the kill. The cell runs in real time (speed factor 1) and as fast as it goes (0) in turn.
"""

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from lathe_rc import harness, resources
from lathe_rc.bag import reader
from lathe_rc.bag.repairing import recover
from lathe_rc.cell import scenario
from lathe_rc.errors import LatheError


def kill(folder: Path, factor: float, after: float) -> tuple[int, int, float]:
    """Samples that the recorder had taken, those in the bag, and what was lost [s of wall time]."""
    piston = scenario.load(
        resources.find(Path("piston.yaml")),
        ["spindle_encoder.revolutions=2000", f"spindle_encoder.speed_factor={factor}"],
    )
    bag = folder / "bag"
    told: list[tuple[float, int]] = []
    killed = 0.0

    with harness.Processes(harness.with_recorder(piston, bag, keep=True), [[name] for name in PARTS]) as cell:

        def watch(event: harness.Event) -> None:
            nonlocal killed
            if event["event"] == "progress" and not killed:
                told.append((time.monotonic(), int(event["samples"])))
                if told[-1][0] - told[0][0] > after:
                    killed = time.monotonic()
                    os.kill(cell.pids["recorder"], signal.SIGKILL)

        try:
            cell.wait_for_end(watch)
        except LatheError:
            cell.stop()
    recover.mend(bag)
    saved = min(signals["angle"].size for signals in [reader.read_bag(bag).dense["/encoder"]])
    known = [moment for moment, samples in told if samples <= saved]
    return told[-1][1], saved, killed - (known[-1] if known else told[0][0])


PARTS = ["spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder"]


def main() -> None:
    """Kill and count."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    random = np.random.default_rng(5)
    lost: dict[float, list[float]] = {1.0: [], 0.0: []}
    for number in track(range(kills), "kills", console=Console(stderr=True)):
        with tempfile.TemporaryDirectory() as folder:
            factor = [1.0, 0.0][number % 2]
            lost[factor].append(kill(Path(folder), factor, random.uniform(1.0, 4.0))[2])
    table = Table("speed factor", "kills", "median [s]", "largest [s]", title="lost when the recorder is killed")
    for factor, found in lost.items():
        if found:
            table.add_row(f"{factor:g}", str(len(found)), f"{np.median(found):.2f}", f"{max(found):.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
