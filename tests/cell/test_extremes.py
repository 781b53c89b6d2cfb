# SPDX-License-Identifier: Apache-2.0
"""Parameters that no machine has are refused by name, also where the tables set no limits."""

from pathlib import Path

import pytest

from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

CONFIG = Path(__file__).parents[2] / "config"


def made(scenario, values):
    cell = Cell(scenario.varied(values).nodes)
    cell.check()
    return cell


@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")
@pytest.mark.parametrize("value", [1e300, 1e-300])
def test_no_parameter_ends_in_a_failure_of_floating_point(value):
    """Every number of every stage, far beyond what it can be: the cell is made and checked, or refused in one line."""
    seen, refused = set(), []
    for path in sorted(CONFIG.glob("*.yaml")):
        scenario = load(path)
        for node, table in scenario.nodes.items():
            for name, row in type(table).rows().items():
                if row.type is float and not row.is_list and (type(table), name) not in seen:
                    seen.add((type(table), name))
                    try:
                        made(scenario, {f"{node}.{name}": value})
                    except LatheError as error:
                        refused.append(str(error))
    assert len(seen) > 300
    assert not [message for message in refused if len(message.splitlines()) != 1]
