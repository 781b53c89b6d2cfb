# SPDX-License-Identifier: Apache-2.0
"""Fixed properties of a scenario in the drawings of the panel."""

from typing import Any

from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.time_master import TimeMasterParameters
from lathe_rc.judge.budget import changing
from lathe_rc.stages.cut.cutting_process import CuttingProcessParameters
from lathe_rc.stages.feed.force_controller import ForceControllerParameters
from lathe_rc.stages.supervisor import SupervisorParameters
from lathe_rc.stages.tool.tool import ToolParameters


def outlook(scenario: Scenario) -> dict[str, Any]:
    """Return the name, tolerance and shape of a scenario, for the drawings of the page; lengths in µm and mm."""
    causes = changing({name: table.model_dump() for name, table in scenario.nodes.items()})
    causes += ["cut"] if scenario.first(CuttingProcessParameters) else []
    return {**_outlook(scenario, scenario.shared.step, scenario.shared.nominal_rpm), "changing": causes}


def plain_outlook(name: str, step: float) -> dict[str, Any]:
    """Return the same for an unknown scenario with a sampling step [s]."""
    return {**_outlook(Scenario(name, {}), step, 0.0), "part": True}


def _outlook(scenario: Scenario, step: float, rpm: float) -> dict[str, Any]:
    tool, cut = scenario.first(ToolParameters), scenario.first(CuttingProcessParameters)
    watch, force = scenario.first(SupervisorParameters), scenario.first(ForceControllerParameters)
    master = scenario.first(TimeMasterParameters)
    return {
        "name": scenario.name,
        "step": step,
        "part": tool is not None,
        "tolerance": tool.tolerance * 1e6 if tool else 0.0,
        "fed": bool(tool and (tool.feed or tool.height_from == "slide")),
        "gaps": list(zip(cut.gap_start, cut.gap_width, strict=True)) if cut else [],
        "radius": 1e3 * (cut.radius if cut else tool.part_radius if tool else 0.05),
        "rpm": rpm,
        "force": max(force.set_point, default=0.0) if force else 0.0,
        "supervised": watch is not None,
        "margin": max(watch.margin_limit, default=0.0) if watch else 0.0,
        "revolutions": master.revolutions if master else 0.0,
    }
