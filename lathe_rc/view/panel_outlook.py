# SPDX-License-Identifier: Apache-2.0
"""Fixed properties of a scenario in the drawings of the panel."""

from typing import Any

from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stages.cutting_process import CuttingProcessParameters
from lathe_rc.cell.stages.force_controller import ForceControllerParameters
from lathe_rc.cell.stages.supervisor import SupervisorParameters
from lathe_rc.cell.stages.time_master import TimeMasterParameters
from lathe_rc.cell.stages.tool import ToolParameters


def outlook(scenario: Scenario) -> dict[str, Any]:
    """Return the name, tolerance and shape of a scenario, for the drawings of the page; lengths in µm and mm."""
    tables = list(scenario.nodes.values())
    tool = next((table for table in tables if isinstance(table, ToolParameters)), None)
    cut = next((table for table in tables if isinstance(table, CuttingProcessParameters)), None)
    watch = next((table for table in tables if isinstance(table, SupervisorParameters)), None)
    force = next((table for table in tables if isinstance(table, ForceControllerParameters)), None)
    return {
        "name": scenario.name,
        "step": scenario.shared.step,
        "part": tool is not None,
        "tolerance": tool.tolerance * 1e6 if tool else 0.0,
        "fed": bool(tool and (tool.feed or tool.height_from == "slide")),
        "gaps": list(zip(cut.gap_start, cut.gap_width, strict=True)) if cut else [],
        "radius": 1e3 * (cut.radius if cut else tool.part_radius if tool else 0.05),
        "rpm": scenario.shared.nominal_rpm,
        "force": max(force.set_point, default=0.0) if force else 0.0,
        "margin": max(watch.margin_limit, default=0.0) if watch else 0.0,
        "revolutions": next((table.revolutions for table in tables if isinstance(table, TimeMasterParameters)), 0.0),
    }


def plain_outlook(name: str, step: float) -> dict[str, Any]:
    """Return the same for an unknown scenario with a sampling step [s]."""
    unknown: dict[str, Any] = {
        "part": True,
        "tolerance": 0.0,
        "fed": False,
        "gaps": [],
        "radius": 50.0,
        "rpm": 0.0,
        "force": 0.0,
        "margin": 0.0,
        "revolutions": 0.0,
    }
    return {"name": name, "step": step, **unknown}
