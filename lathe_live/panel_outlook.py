# SPDX-License-Identifier: Apache-2.0
"""Fixed properties of a scenario in the drawings of the panel."""

from collections.abc import Iterable, Mapping
from typing import Any

from lathe_rc.cell.scenario import Scenario
from lathe_rc.judge.causes import EVERYWHERE, changing


def outlook(scenario: Scenario) -> dict[str, Any]:
    """Return the name, tolerance and shape of a scenario, for the drawings of the page; lengths in µm and mm."""
    nodes = {name: table.model_dump() for name, table in scenario.nodes.items()}
    causes = changing(nodes)
    bent = any(values.get(name, off) != off for values in nodes.values() for name, off in EVERYWHERE["force"].items())
    shown = properties(table.shown() for table in scenario.nodes.values())
    causes += ["cut"] if shown.get("cut") else []
    return {
        **_outlook(scenario.name, scenario.shared.step, scenario.shared.nominal_rpm, shown),
        "changing": causes,
        "bent": bent,
    }


def plain_outlook(name: str, step: float) -> dict[str, Any]:
    """Return the same for an unknown scenario with a sampling step [s]."""
    return {**_outlook(name, step, 0.0, {}), "part": True}


def properties(shown: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the properties that several nodes show, of each the first."""
    found: dict[str, Any] = {}
    for each in shown:
        found = {**each, **found}
    return found


def _outlook(name: str, step: float, rpm: float, shown: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": name,
        "step": step,
        "part": shown.get("part", False),
        "tolerance": shown.get("tolerance", 0.0),
        "by_zone": shown.get("by_zone", False),
        "fed": shown.get("fed", False),
        "gaps": shown.get("gaps", []),
        "radius": shown.get("cut_radius", shown.get("radius", 50.0)),
        "rpm": rpm,
        "force": shown.get("force", 0.0),
        "force_limit": shown.get("force_limit", 0.0),
        "supervised": shown.get("supervised", False),
        "margin": shown.get("margin", 0.0),
        "revolutions": shown.get("revolutions", 0.0),
    }
