# SPDX-License-Identifier: Apache-2.0
"""Comparison of a cell's digests across all hosts, for testing a user's own stage."""

import importlib.util
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from lathe_bagtools.resimulation import resim
from lathe_rc import allowed_code, harness
from lathe_rc.bag import reader
from lathe_rc.cell import batch
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell

Digests = Mapping[str, str]  #: digest of each signal topic

_OTHER_BLOCK = 23  # [sample]; divides neither a revolution nor a second


def digests_by_host(scenario: Scenario, folder: str | os.PathLike[str]) -> dict[str, Digests]:
    """Return a scenario's signal digests in every host on this computer; they differ only if a stage is wrong.

    Args:
        scenario: the scenario; it should be short, since it runs seven times.
        folder: folder for the bag.

    Returns:
        Digests by host: ``offline`` (also re-simulated from its bag), offline with another block length, as a cell of
        a batch and, if ROS 2 is installed, composed in one process and with one process per node.

    Raises:
        LatheError: a run failed.

    Example:
        >>> import lathe_bagtools
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=2"])
        >>> found = lathe_bagtools.digests_by_host(piston, ".")
        >>> all(digests == found["offline"] for digests in found.values())
        True
    """
    return dict(_runs(scenario, Path(folder)))


def _runs(scenario: Scenario, folder: Path) -> Iterator[tuple[str, Digests]]:
    bag = folder / "offline"
    yield "offline", harness.run(scenario, mode="offline", bag=bag).digest
    yield "bag", reader.read_bag(bag).digests()
    # A bag does not hold machine code.
    code = [
        f"{node}.{name}={file}"
        for node, table in scenario.nodes.items()
        for name in allowed_code.FILES
        if (file := getattr(table, name, ""))
    ]
    yield "simulated again", resim.resimulate(bag, code).digest
    other = scenario.varied({"block_size": _OTHER_BLOCK})
    yield f"blocks of {_OTHER_BLOCK}", harness.run(other, mode="offline").digest
    yield "batch", _in_a_batch(scenario)
    if importlib.util.find_spec("rclpy"):
        for mode in ("composed", "processes"):
            yield mode, harness.run(scenario, mode=mode).digest


def _in_a_batch(scenario: Scenario) -> Digests:
    cell = Cell(scenario.nodes)
    outcome = next(batch.run_many([scenario], [*cell.dense, *cell.sparse]))
    if outcome.error is not None:
        raise outcome.error
    assert outcome.kept is not None, "it has not failed"
    return outcome.kept.digests()
