# SPDX-License-Identifier: Apache-2.0
"""Run of a cell of ROS nodes, in one process or in several."""

import contextlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lathe_rc import messages, process_launcher
from lathe_rc.bag import reader
from lathe_rc.bag.repairing import recover
from lathe_rc.blocks.latency_histogram import Lateness
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.harness import bags
from lathe_rc.harness.processes import Processes, with_recorder
from lathe_rc.harness.result import Event, Mode, Result
from lathe_rc.process_launcher import Start


def run_hosted(
    scenario: Scenario,
    cell: Cell,
    mode: Mode,
    groups: Sequence[Sequence[str]] | None,
    bag: Path | None,
    watch: Callable[[Event], None],
    domain: int | None,
    namespace: str,
    start: Start,
) -> Result:
    """Run a cell of ROS nodes to its end (see `lathe_rc.harness.runner.run`)."""
    if start == "fork":
        nodes = {name: (scenario.kind(name), table.model_dump()) for name, table in scenario.nodes.items()}
        process_launcher.server().preload(nodes)
    with contextlib.ExitStack() as stack:
        table = scenario.recorder[1]
        folder = table.snapshots_of(bag) if bag is not None and table.mode != "continuous" else None
        place = kept = bags.of_whole(scenario, bag)
        if place is None:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lathe-"))) / "bag"
        complete = with_recorder(scenario, place, keep=bag is not None, snapshots=folder)
        split = [list(complete.nodes)] if mode == "composed" else complete.processes(groups)
        processes = stack.enter_context(Processes(complete, split, domain=domain, namespace=namespace, start=start))
        try:
            events = processes.wait_for_end(watch)
        except BaseException:
            processes.stop()
            for path in ([kept] if kept else []) + bags.snapshots_in(folder):
                recover.mend(path)
            raise
        recording = reader.read_bag(place)
        return Result(
            scenario=scenario,
            mode="grouped" if mode == "processes" and len(split) < len(complete.nodes) else mode,
            samples=cell.master.samples - cell.first
            if cell.master.samples
            else recording.of_type(messages.ENCODER)["angle"].size,
            wall_s=(events["complete"]["monotonic_ns"] - events["block0"]["monotonic_ns"]) * 1e-9,
            bag=kept,
            snapshots=tuple(bags.snapshots_in(folder)),
            recording=recording,
            refused=processes.refused,
            not_reached=processes.not_reached,
            lateness=_lateness(events),
        )


def _lateness(events: Mapping[str, Event]) -> Lateness | None:
    """Return the lateness of the blocks as reported by the time master."""
    if "pace" not in events:
        return None
    told = events["pace"]
    within = {int(percent): seconds for percent, seconds in told["within"].items()}  # JSON keys are strings
    return Lateness(told["blocks"], told["late"], told["worst"], within, told["slipped"])
