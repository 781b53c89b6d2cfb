# SPDX-License-Identifier: Apache-2.0
"""The offline engine is compared with plain C on one core, in the two-channel cell and the full cell of 13 nodes.

benchmarks/c has the same arithmetic, sample by sample, compiled with -O3 -march=native. With -ffp-contract=off its
results are bit-identical, checked in every field of every block topic. A ratio is the speed of the engine over that of
C. On both sides NumPy draws the random allowance of the full cell within the measured time. The signals have no reader,
and neither side makes messages at chosen samples (joint states, learning status) or identifies its drives.

``real_time_factor`` is that of the engine in the same run. For the unmodified scenario, ``unchanged_real_time_factor``
is that of the engine, and ``recorded_real_time_factor`` that of ``lathe_rc.run`` with a bag, on one core, from the
first sample until the bag is closed. ``engine_share``, ``zstd_share`` and ``digests_share`` are the times of these over
that of the recorded run; the digests (SHA-256) are computed after the bag is closed, so they come on top.
"""

import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from benchmarks.plain_c import PlainC, compiled
from benchmarks.sides import alternate, one_core, ratio, seconds, spread
from lathe_rc import allowed_code, harness, resources
from lathe_rc.bag.writing import mcap_file
from lathe_rc.cell import scenario
from lathe_rc.cell.collect import Collector
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.scaffold import begin

Say = Callable[[str], None]
_CHUNK = 1024  # [sample] at a time in C: the quickest of 64 to 3200
_NOT_IDENTIFIED = ("learning_controller.identify=false", "fine_controller.identify=false")
#: Beside the scenario: what the C leaves out, and what it has but the scenario has not.
OVERRIDES = {
    "two_channel": (*_NOT_IDENTIFIED, "piezo_actuator.amplifier_lag=40e-6"),
    "full_cell": _NOT_IDENTIFIED,
}


@dataclass(frozen=True)
class Against:
    """How a cell is measured against C.

    Attributes:
        revolutions: quick, and in full.
        rounds: the same.
        c_ratio, real_time_factor: the targets.
    """

    revolutions: tuple[float, float]
    rounds: tuple[int, int]
    c_ratio: float
    real_time_factor: float


_AGAINST = {
    "two_channel": Against((150.0, 600.0), (5, 15), c_ratio=0.95, real_time_factor=150.0),
    "full_cell": Against((75.0, 200.0), (5, 15), c_ratio=0.85, real_time_factor=60.0),
}
#: Scenarios of which only the pace counts, as they stand.
_PACES = ("interrupted_cut", "force_turning", "supervised_turning")
_PACE = 40.0  # target of all of them, and of the full cell when it is recorded


def loaded(name: str, revolutions: float, *overrides: str) -> Scenario:
    """A scenario of so many revolutions."""
    return scenario.load(
        resources.find(Path(f"{name}.yaml")), [f"spindle_encoder.revolutions={revolutions}", *overrides]
    )


def cell(name: str, revolutions: float, *overrides: str) -> Cell:
    """A cell as it is measured against C."""
    return Cell(loaded(name, revolutions, *OVERRIDES[name], *overrides).nodes)


def difference(name: str, revolutions: float) -> str:
    """The first signal in which C without contraction differs from the engine; empty if all bits are equal."""
    engine = Engine(cell(name, revolutions))
    collector = Collector(cell(name, revolutions), engine.samples)
    engine.run([collector])
    dense = collector.recording().dense
    plain = PlainC(name, compiled(name, "-ffp-contract=off"), cell(name, revolutions), _CHUNK)
    for first in range(0, engine.samples, _CHUNK):
        samples = min(_CHUNK, engine.samples - first)
        plain.step(first, samples)
        for (topic, field), array in plain.signals.items():
            found, wanted = array[:samples], dense[f"/{topic}"][field][first : first + samples]
            if found.tobytes() != wanted.tobytes():
                bits = f"u{found.itemsize}"
                place = int(np.argmax(found.view(bits) != wanted.view(bits)))
                return f"/{topic}.{field} at sample {first + place}: {found[place]!r}, engine {wanted[place]!r}"
    return ""


# ---- sides: each gives wall time a sample [s] ------------------------------------------------------------------------


def _engine(made: Cell) -> float:
    engine = Engine(made, heard=())
    return seconds(lambda: engine.run([])) / engine.samples


def _unchanged(name: str, revolutions: float) -> float:
    return _engine_of(loaded(name, revolutions))


def _engine_of(chosen: Scenario) -> float:
    return _engine(Cell(chosen.nodes))


def plain(name: str, revolutions: float, *flags: str, at_once: int = 1) -> Callable[[], float]:
    """A side that runs a cell in C, compiled with ``flags``; so many of them at once."""
    library = compiled(name, *flags)

    def side() -> float:
        samples = cell(name, revolutions).samples
        runs = [PlainC(name, library, cell(name, revolutions), _CHUNK) for _ in range(at_once)]
        with ThreadPoolExecutor(at_once) as pool:
            return seconds(lambda: list(pool.map(lambda run: run.run(samples), runs))) / samples

    return side


def _recorded(name: str, revolutions: float) -> float:
    with one_core(), tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        run = harness.run(loaded(name, revolutions), bag=Path(folder) / "bag")
    return run.wall_s / run.samples


def _digested(name: str, revolutions: float) -> float:
    run = harness.run(loaded(name, revolutions))
    with one_core():
        return seconds(run.recording.digests) / run.samples


def _compressed(name: str, revolutions: float) -> float:
    """The same of the compression of the bag's chunks, as in `lathe_rc.bag.writing.mcap_file`."""
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        made = loaded(name, revolutions, "recorder.compression=none")
        run = harness.run(made, bag=Path(folder) / "bag")
        whole = next(Path(folder).glob("bag/*.mcap")).read_bytes()
    size = made.recorder[1].chunk_size
    compressor = zstandard.ZstdCompressor(level=mcap_file.LEVEL)
    pieces = [whole[start : start + size] for start in range(0, len(whole), size)]
    with one_core():
        return seconds(lambda: [compressor.compress(piece) for piece in pieces]) / run.samples


def _of_recording(name: str, revolutions: float, rounds: int) -> dict[str, Any]:
    """What a recorded run on one core consists of, each over its time until the bag is closed."""
    turns = {
        "recorded": partial(_recorded, name, revolutions),
        "engine": partial(_unchanged, name, revolutions),
        "zstd": partial(_compressed, name, revolutions),
        "digests": partial(_digested, name, revolutions),
    }
    times = _asked(turns, rounds)
    return {f"{side}_share": ratio(times[side], times["recorded"]) for side in ("engine", "zstd", "digests")}


def sides(name: str, revolutions: float) -> dict[str, Callable[[], float]]:
    """What takes turns on a cell."""
    return {
        "engine": lambda: _engine(cell(name, revolutions)),
        "c": plain(name, revolutions, "-ffp-contract=off"),
        "c_contracted": plain(name, revolutions),
    }


# ---- figures ---------------------------------------------------------------------------------------------------------


def _asked(turns: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Figures of some sides that have been compiled, and whose files have been read, before they count."""
    for side in turns.values():
        side()
    return alternate(turns, rounds)


def _factor(name: str, times: list[float]) -> dict[str, float]:
    step = loaded(name, 1.0).shared.step
    return spread([step / time for time in times])


def against_c(name: str, *, quick: bool) -> dict[str, Any]:
    """A cell beside its C.

    Raises:
        LatheError: they differ.
    """
    about = _AGAINST[name]
    revolutions, rounds = (pair[not quick] for pair in (about.revolutions, about.rounds))
    if differs := difference(name, 40.0):
        raise LatheError(f"plain C and the engine differ first in {differs}")
    found = _asked(sides(name, revolutions), int(rounds))
    return {
        "same_bits_as_c": True,
        "c_ratio": ratio(found["c"], found["engine"]),
        "target_c_ratio": about.c_ratio,
        "c_contracted_ratio": ratio(found["c_contracted"], found["engine"]),
        "real_time_factor": _factor(name, found["engine"]),
        "target_real_time_factor": about.real_time_factor,
        "ns_per_sample": {side: spread([t * 1e9 for t in times]) for side, times in found.items()},
    }


def paces(say: Say, *, quick: bool) -> dict[str, dict[str, Any]]:
    """How fast scenarios are as they stand: the engine alone, and recorded."""
    names = ["full_cell", *_PACES]
    revolutions, rounds = (50.0, 3) if quick else (200.0, 9)
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        say(f"engine {name}")
        turns = {
            "engine": partial(_unchanged, name, revolutions),
            "recorded": partial(_recorded, name, revolutions),
        }
        times = _asked(turns, rounds)
        found[name] = {
            "real_time_factor": _factor(name, times["engine"]),
            "recorded_real_time_factor": _factor(name, times["recorded"]),
        }
    return found


def own(*, quick: bool) -> dict[str, dict[str, Any]]:
    """A law and a drive of ``lathe new``, each in the place of ours; a ratio above 1 is faster than ours."""
    revolutions, rounds = (50.0, 5) if quick else (400.0, 15)
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        for kind in ("law", "plant"):
            begin(kind, f"own_{kind}", Path(folder), compiled=True)
            allowed_code.allow(f"own_{kind}")
            sys.path.append(f"{folder}/own_{kind}")
        length = f"spindle_encoder.revolutions={revolutions}"
        files = {kind: Path(folder) / f"own_{kind}" / f"own_{kind}.yaml" for kind in ("law", "plant")}
        with_law = scenario.load(files["law"], [length])
        with_drive = scenario.load(files["plant"], [length, "learning_controller.identify=false"])
        ours_drive = with_law.nodes["electrodynamic_actuator"].model_copy(update={"stage": "electrodynamic_actuator"})
        ours = Scenario("ours", with_drive.nodes | {"own_plant": ours_drive})
        chosen = {"law": with_law, "drive": with_drive, "ours": ours}
        turns = {name: partial(_engine_of, each) for name, each in chosen.items()}
        found = _asked(turns, rounds)
    return {name: {"ratio_to_ours": ratio(found["ours"], found[name])} for name in ("law", "drive")}


def measure(*, quick: bool, say: Say) -> dict[str, Any]:
    """See the module; the two-channel cell first, the full cell and those of which only the pace counts as groups."""
    say("engine two_channel")
    found = against_c("two_channel", quick=quick)
    say("engine full_cell against C")
    whole = against_c("full_cell", quick=quick)
    pace = paces(say, quick=quick)
    unchanged = pace.pop("full_cell")
    whole["unchanged_real_time_factor"] = unchanged["real_time_factor"]
    whole["recorded_real_time_factor"] = unchanged["recorded_real_time_factor"]
    whole["target_recorded_real_time_factor"] = _PACE
    whole |= _of_recording("full_cell", *((50.0, 3) if quick else (200.0, 9)))
    for factors in pace.values():
        factors |= {f"target_{key}": _PACE for key in tuple(factors)}
    say("engine with stages of one's own")
    return {**found, "full_cell": whole, **pace, "own": own(quick=quick)}
