# SPDX-License-Identifier: Apache-2.0
"""The scenario that the processes of a cell run: that of the user, with a recorder that all others wait for."""

from pathlib import Path

from lathe_rc.cell.scenario import Scenario


def with_recorder(scenario: Scenario, bag: Path, *, keep: bool, snapshots: Path | None = None) -> Scenario:
    """The scenario as its processes run it: with a recorder on ``bag``, and a spindle that waits for all members.

    With ``snapshots`` it makes those too, in that folder; what is not to be kept has none.
    """
    nodes = dict(scenario.nodes)
    name, table = scenario.recorder
    changes: dict[str, object] = {"bag": str(bag.resolve())}
    if not keep:
        changes |= {"compression": "none", "mode": "continuous"}
    elif snapshots is not None:
        changes |= {"mode": "both", "snapshots": str(snapshots.resolve())}
    nodes[name] = table.model_copy(update=changes)
    for master in scenario.masters:
        others = [node for node in nodes if node != master]
        nodes[master] = nodes[master].model_copy(update={"members": others})
    return Scenario(scenario.name, nodes)
