# SPDX-License-Identifier: Apache-2.0
"""How time and memory grow: what should be flat, is it?

The offline engine alone, without sinks, runs ``config/one_channel.yaml`` with an oval, varied in one
respect:

- ``length``: blocks (of 64 samples) in the run,
- ``samples_per_revolution``: by the speed of the spindle,
- ``memory_points``: points of the memory per revolution,
- ``channels``: that many learning controllers and drives in series, all alike,
- ``q_exponential``, ``q_gaussian``: width of Q in points of the memory.

Each point has the time per block from the fifth revolution on: before, each controller takes some 15 ms for the
stability margins of the drive that it identifies. ``length`` has the whole run per block as well. ``peak_mb`` is the
most memory that Python and NumPy hold for the cell during its run (tracemalloc, in a run of its own; with --quick for
``length`` only). A slope is that of log(y) over log(x), by least squares, of times the median of the rounds: 0 is
flat, 1 is linear. ``total_time_slope`` is that of the time of the whole run over its length.

``bag`` is the memory while bags of some lengths are recorded offline, and while ``lathe bag info`` reads them; not with
--quick.
"""

import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import sides
from lathe_rc import resources
from lathe_rc.bag.reading import stream
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.writing.record import OfflineRecorder, begin
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import scenario
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.judge import part
from lathe_rc.messages import Signals

Point = dict[str, Any]

_BLOCK = 64  # samples
_REVOLUTION = 3840  # samples at 1000 rpm
_DELAY = 640  # of the feedback where a revolution is short [sample]; the engine's pieces are as long
_BEFORE = 4.0  # revolutions that are not counted
_MB = 1e-6
_KINDS = {  # of the nodes of a channel, with the topics that are its own
    "learning_controller": ("command", "learning", "state"),
    "electrodynamic_actuator": ("command", "state"),
}


class _Clock:
    """A sink that keeps nothing but the moment from which a sample on is computed."""

    def __init__(self, sample: float) -> None:
        self._sample = sample
        self.moment = self.first = 0.0

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        if not self.first and first + samples >= self._sample:
            self.moment, self.first = time.perf_counter(), first + samples


class _Case:
    """A scenario that is run again and again.

    Args:
        varied: its path.
        overrides: what is changed in it.
        blocks: length of the run, at least.
        revolution: samples in it.

    Attributes:
        blocks: see above.
        whole: time of each run so far, from the first sample on [µs per block].
    """

    def __init__(self, varied: Path, overrides: Sequence[str], blocks: int, revolution: float) -> None:
        turns = max(blocks * _BLOCK / revolution, 2.0 * _BEFORE)
        self.scenario = scenario.load(
            varied, ["tool.profile=harmonics", *overrides, f"spindle_encoder.revolutions={turns!r}"]
        )
        Cell(self.scenario.nodes).check()
        self.blocks, self._start = blocks, _BEFORE * revolution
        self.whole: list[float] = []

    def us_per_block(self) -> float:
        """Time of a run [µs per block]."""
        engine, clock = Engine(Cell(self.scenario.nodes)), _Clock(self._start)
        start = time.perf_counter()
        engine.run([clock])
        end = time.perf_counter()
        self.whole.append((end - start) / engine.samples * _BLOCK * 1e6)
        return (end - clock.moment) / (engine.samples - clock.first) * _BLOCK * 1e6

    def peak_mb(self) -> float:
        """Memory during a run, that of the cell included."""
        return _peak_mb(lambda: partial(Engine(Cell(self.scenario.nodes)).run, []))


def _peak_mb(prepare: Callable[[], Callable[[], object]]) -> float:
    """The most memory that is held while an action runs, with what preparing it has left."""
    tracemalloc.start()
    try:
        action = prepare()
        tracemalloc.reset_peak()
        action()
        return tracemalloc.get_traced_memory()[1] * _MB
    finally:
        tracemalloc.stop()


def _slope(x: Iterable[str], y: Iterable[float]) -> float:
    """Of log(y) over log(x)."""
    return float(np.polyfit(np.log([float(text) for text in x]), np.log(list(y)), 1)[0])


def _slopes(x: Sequence[str], columns: Mapping[str, Sequence[float]]) -> sides.Spread:
    """Slopes of the rounds: what was measured in one of them belongs together."""
    return sides.spread([_slope(x, y) for y in zip(*columns.values(), strict=True)])


def _channels(number: int, folder: Path) -> Path:
    """A parameter file with so many channels in series, as config/two_coarse.yaml has two."""
    tree = yaml.safe_load(resources.find(Path("one_channel.yaml")).read_text(encoding="utf-8"))
    table = {name: node["ros__parameters"] for name, node in tree.items()}
    names = ["coarse", *(f"channel_{k}" for k in range(2, number + 1))]
    table["/tool"]["drives"] = names
    for place, name in enumerate(names):
        for kind, topics in _KINDS.items():
            remap = [f"coarse/{topic}:={name}/{topic}" for topic in topics]
            table[f"/{name}_{kind}"] = {**table[f"/{kind}"], "stage": kind} | ({"remap": remap} if place else {})
        if finer := names[place + 1 :]:
            table[f"/{name}_learning_controller"]["finer"] = finer
    for kind in _KINDS:
        del table[f"/{kind}"]
    path = folder / f"channels-{number}.yaml"
    path.write_text(yaml.safe_dump({name: {"ros__parameters": values} for name, values in table.items()}))
    return path


def _cases(folder: Path, *, quick: bool) -> Iterator[tuple[str, dict[str, _Case]]]:
    """What is varied, and the case of each value."""
    one = resources.find(Path("one_channel.yaml"))
    blocks = 1000 if quick else 10_000
    per_point = 60.0 / 1000.0 / 1024  # time that a point of the memory lasts [s]
    lengths = [10**3, 10**4] if quick else [10**4, 10**5, 10**6]
    revolutions = [1920, 30720] if quick else [1920, 3840, 7680, 15360, 30720, 61440]
    sizes = [512, 8192] if quick else [256, 512, 1024, 2048, 4096, 8192]
    channels = [1, 2, 4] if quick else [1, 2, 3, 4]
    widths = [2.0, 16.0] if quick else [2.0, 4.0, 8.0, 16.0]

    def revolution(samples: int) -> _Case:
        speed = f"nominal_rpm={64000 * 60 / samples!r}"
        return _Case(one, [f"learning_controller.feedback_delay={_DELAY}", speed], blocks, samples)

    def varied(*overrides: str) -> _Case:
        return _Case(one, [f"learning_controller.{text}" for text in overrides], blocks, _REVOLUTION)

    yield "length", {str(length): _Case(one, [], length, _REVOLUTION) for length in lengths}
    yield "samples_per_revolution", {str(samples): revolution(samples) for samples in revolutions}
    yield "memory_points", {str(size): varied(f"points_per_revolution={size}") for size in sizes}
    yield "channels", {str(n): _Case(_channels(n, folder), [], blocks, _REVOLUTION) for n in channels}
    for kind in ("exponential", "gaussian"):
        widened = {f"{width:g}": varied(f"q_filter={kind}", f"q_time={width * per_point!r}") for width in widths}
        yield f"q_{kind}", widened


def _bags(folder: Path) -> dict[str, Any]:
    """Memory of recording and of reading, by blocks in the bag."""
    points: dict[str, Point] = {}
    for blocks in (2500, 10_000, 40_000):
        case = _Case(resources.find(Path("one_channel.yaml")), [], blocks, _REVOLUTION)
        bag = folder / f"bag-{blocks}"
        points[str(blocks)] = {
            "record_peak_mb": _peak_mb(lambda: _record(case.scenario, bag)),  # noqa: B023 - called at once
            "info_peak_mb": _peak_mb(lambda: _info(bag)),  # noqa: B023
        }
    return {
        "points": points,
        "record_memory_slope": _slope(points, [point["record_peak_mb"] for point in points.values()]),
        "info_memory_slope": _slope(points, [point["info_peak_mb"] for point in points.values()]),
    }


def _record(what: Scenario, bag: Path) -> Callable[[], None]:
    cell = Cell(what.nodes)
    engine, writer = Engine(cell), begin(bag, what)
    sink = OfflineRecorder(cell, engine.samples, writer)

    def run() -> None:
        engine.run([sink])
        writer.close()

    return run


def _info(bag: Path) -> Callable[[], None]:
    """What ``lathe bag info`` reads."""
    with BagSource(bag) as source:
        types = {topic: said.type for topic, said in source.topics.items()}
    ends = part.FirstAndLast(types)

    def run() -> None:
        stream.feed(bag, [ends])
        ends.numbers()

    return run


def _grown(cases: Mapping[str, _Case], rounds: int, *, whole: bool, memory: bool) -> dict[str, Any]:
    """Time and memory of the cases of one kind."""
    next(iter(cases.values())).us_per_block()  # compiles
    for case in cases.values():
        case.whole.clear()
    found = sides.alternate({x: case.us_per_block for x, case in cases.items()}, rounds)
    points: dict[str, Point] = {x: {"us_per_block": sides.spread(found[x])} for x in cases}
    result: dict[str, Any] = {"points": points, "time_per_block_slope": _slopes(list(cases), found)}
    if whole:
        total = {x: [us * case.blocks for us in case.whole] for x, case in cases.items()}
        result["total_time_slope"] = _slopes(list(cases), total)
        for x, case in cases.items():
            points[x]["whole_us_per_block"] = sides.spread(case.whole)
    if memory:
        for x, case in cases.items():
            points[x]["peak_mb"] = case.peak_mb()
        result["memory_slope"] = _slope(points, [point["peak_mb"] for point in points.values()])
    return result


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Time and memory of every case."""
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as name:
        folder = Path(name)
        for what, cases in _cases(folder, quick=quick):
            say(f"  {what}")
            length = what == "length"
            rounds = 2 if quick else 3 if length else 5
            result[what] = _grown(cases, rounds, whole=length, memory=length or not quick)
        if not quick:
            say("  bags")
            result["bag"] = _bags(folder)
    return result


# ---- drawing ------------------------------------------------------------------------------------------------------

_PANELS = {
    "length": "blocks in the run",
    "samples_per_revolution": "samples per revolution",
    "memory_points": "points of the memory per revolution",
    "channels": "channels",
    "q_exponential": "width of Q [points of the memory]",
}
_INK, _PALE, _OTHER = "#1f6f8b", "#999999", "#c0392b"


def _curve(axes: Axes, points: Mapping[str, Any], key: str, label: str, colour: str) -> list[tuple[float, float]]:
    """Draw medians with their ranges, or single values; returns what was drawn."""
    known = {float(x): point[key] for x, point in points.items() if key in point}
    if not known:
        return []
    rows = [(y, y, y) if not isinstance(y, Mapping) else (y["median"], y["low"], y["high"]) for y in known.values()]
    middle, low, high = np.array(rows).T
    axes.errorbar(
        list(known), middle, [middle - low, high - middle], fmt=".-", color=colour, label=label, lw=1.2, ms=7, capsize=2
    )
    return list(zip(known, middle.tolist(), strict=True))


def _finish(axes: Axes, title: str, label: str, unit: str, drawn: Sequence[tuple[float, float]]) -> None:
    """Name everything, and draw what would be linear."""
    numbers = sorted({x for x, _ in drawn})
    start, first = min(drawn)
    if numbers[-1] / start > 10.0:
        axes.set_xscale("log")
    line = np.geomspace(start, numbers[-1], 100)
    axes.plot(line, first * line / start, ":", color=_PALE, lw=1.0, label="if it were linear")
    axes.set(xlabel=label, ylabel=unit, ylim=(0.0, 1.8 * max(y for _, y in drawn)))
    axes.set_title(title, fontsize=10)
    axes.set_xticks(numbers, [f"{x:,.0f}".replace(",", "\u202f") for x in numbers], fontsize=8)
    axes.minorticks_off()
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.legend(fontsize=8, loc="upper left")


def _signed(slope: float) -> str:
    return f"{round(slope, 2) + 0.0:+.2f}".replace("-", "−")


def plot(result: Mapping[str, Any], path: Path) -> None:
    """Draw a result of `measure` into a PNG file: a flat curve means that nothing grows."""
    figure = Figure(figsize=(13, 7), layout="constrained")
    FigureCanvasAgg(figure)
    places = iter(figure.subplots(2, 3).flat)
    for what, label in _PANELS.items():
        axes, found = next(places), result[what]
        q = what == "q_exponential"
        drawn = _curve(axes, found["points"], "us_per_block", "exponential" if q else "steady", _INK)
        drawn += _curve(axes, found["points"], "whole_us_per_block", "whole run", _OTHER)
        slope = _signed(found["time_per_block_slope"]["median"])
        if q:
            other = result["q_gaussian"]
            drawn += _curve(axes, other["points"], "us_per_block", "Gaussian", _OTHER)
            slope += f" and {_signed(other['time_per_block_slope']['median'])}"
        _finish(axes, f"time per block: slope {slope}", label, "µs per block", drawn)
    axes, bags = next(places), result.get("bag", {}).get("points", {})
    drawn = _curve(axes, result["length"]["points"], "peak_mb", "offline run that keeps nothing", _INK)
    drawn += _curve(axes, bags, "record_peak_mb", "recording a bag", _OTHER)
    drawn += _curve(axes, bags, "info_peak_mb", "lathe bag info", "#27ae60")
    slope = _signed(result["length"]["memory_slope"])
    _finish(axes, f"memory: slope {slope} without a bag", "blocks in the run", "MB at most", drawn)
    figure.savefig(path, dpi=110)
