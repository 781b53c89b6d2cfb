# SPDX-License-Identifier: Apache-2.0
"""Compiles what the tests run and nobody has compiled here yet, so that none of them does it, nor two at once."""

import sys

from lathe_rc import harness
from lathe_rc.cell import scenario
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.wiring import Cell
from workplace import ROOT


def main() -> int:
    """Compile the steps of all scenarios on all cores, and begin to run each: what else that needs is compiled, too."""
    scenarios = [
        scenario.load(path, ["spindle_encoder.revolutions=0.5"]) for path in sorted((ROOT / "config").glob("*.yaml"))
    ]
    for _ in compile_ahead(stage for each in scenarios for stage in Cell(each.nodes).stages.values()):
        pass
    for each in scenarios:
        harness.run(each)
    return 0


if __name__ == "__main__":
    sys.exit(main())
