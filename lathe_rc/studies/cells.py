# SPDX-License-Identifier: Apache-2.0
"""Running the scenarios of ``config/`` with changes."""

from collections.abc import Mapping
from pathlib import Path

from lathe_rc import harness, resources
from lathe_rc.cell import scenario
from lathe_rc.cell.scenario import Scenario

Values = Mapping[str, object]


def _yaml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value).replace("'", '"') if isinstance(value, list) else str(value)


def load(name: str, shared: Values | None = None, **nodes: Values) -> Scenario:
    """A scenario of ``config/`` with shared parameters and parameters by node replaced."""
    changes = [f"{parameter}={_yaml(value)}" for parameter, value in (shared or {}).items()]
    changes += [f"{node}.{parameter}={_yaml(v)}" for node, table in nodes.items() for parameter, v in table.items()]
    return scenario.load(resources.find(Path(f"{name}.yaml")), changes)


def run(name: str, shared: Values | None = None, **nodes: Values) -> harness.Result:
    """Run it offline."""
    return harness.run(load(name, shared, **nodes))
