# SPDX-License-Identifier: Apache-2.0
"""Compiles what the tests run and nobody has compiled here yet, so that none of them does it, nor two at once."""

import sys

from lathe_rc import harness
from lathe_rc.cell import scenario
from workplace import ROOT


def main() -> int:
    """Begin to run each scenario: what that needs is compiled on all cores before."""
    for path in sorted((ROOT / "config").glob("*.yaml")):
        harness.run(scenario.load(path, ["spindle_encoder.revolutions=0.5"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
