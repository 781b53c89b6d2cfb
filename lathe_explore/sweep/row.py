# SPDX-License-Identifier: Apache-2.0
"""Table row of one cell of a sweep.

| column | content |
|---|---|
| cell | number within the sweep |
| key | identity of the cell: a hash of the scenario and of the measures |
| status, reason | done; refused by the check before the start; diverged; failed during the run; and the reason |
| NODE.PARAM | parameters that differ between the cells; the value with which the cell ran |
| tool.max_error, tool.rms_error | largest and RMS form error of the last revolution [m] |
| tool.first_max_error, tool.first_rms_error | largest and RMS form error of the first revolution [m] |
| tool.max_errors, tool.rms_errors | largest and RMS form error of each revolution [m] |
| tool.in_tolerance_from | first revolution from which the largest error stays within `tool.tolerance`, or none |
| margin | 1 less the largest factor of a cycle over all frequencies (sup|Q - γZ|): below 0 learning diverges |
| drive_margin | smallest relative error of the drive's response, at one frequency, with which learning diverges |
| limits | nodes that reached a limit of a command or a stroke |
| TOPIC.FIELD:STATISTIC | a measure of the last revolution |
| NODE.FIGURE | a figure of a force or position loop: always without a tool, otherwise if it is asked for |
| revolutions, samples, seconds | numbers of revolutions and samples of the run, and its computing time [s] |
| time_limit | time limit that ended a failed cell [s] |
| seed, version, code, digest | random seed; version of lathe_rc; hash of third-party classes; see `digest` |
"""

import contextlib
import math
import re
import subprocess
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import pyarrow as pa
import xxhash
from numpy.typing import NDArray

from lathe_explore.sweep import NUMBERS
from lathe_rc import __version__, allowed_code, messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.batch import CellRunner, Errors, Topics
from lathe_rc.cell.events import LIMITED, OUT_OF_REACH, parse
from lathe_rc.cell.parameters import Value, form_doubt, judged
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import DivergedError, InputError, LatheError, shown
from lathe_rc.extensions import attribute
from lathe_rc.judge.loops import FIGURES, loops, watches
from lathe_rc.judge.part import Tolerances
from lathe_rc.messages import Signals
from lathe_rc.names import instead
from lathe_rc.signals.form_errors import FormErrors, RunningErrors, turns_before

if TYPE_CHECKING:
    from lathe_explore.sweep.description import Target

DONE, REFUSED, DIVERGED, FAILED = "done", "refused", "diverged", "failed"
LIMITS = (LIMITED, OUT_OF_REACH)  # verbs of the events of a limit

Samples = NDArray[np.float64]

STATISTICS: Mapping[str, Callable[[Samples], float]] = {
    "max": lambda samples: float(np.abs(samples).max()),
    "rms": lambda samples: math.sqrt(float(np.mean(samples * samples))),
    "mean": lambda samples: float(samples.mean()),
    "peak_to_valley": lambda samples: float(np.ptp(samples)),
}  #: of a signal in the last revolution

_ARROW = {"bool": pa.bool_(), "int": pa.int64(), "float": pa.float64(), "str": pa.string()}
HEAD = {"cell": pa.int64(), "key": pa.string(), "status": pa.string(), "reason": pa.string()}  #: columns of each row
_FOUND = dict.fromkeys(NUMBERS, pa.float64()) | {"tool.in_tolerance_from": pa.int64(), "limits": pa.string()}
_TAIL = {
    "tool.max_errors": pa.list_(pa.float64()),
    "tool.rms_errors": pa.list_(pa.float64()),
    "revolutions": pa.int64(),
    "samples": pa.int64(),
    "seconds": pa.float64(),
    "time_limit": pa.float64(),
    "seed": pa.int64(),
    "version": pa.string(),
    "code": pa.string(),
    "digest": pa.string(),
}


class Measure(NamedTuple):
    """Measure of a run: a statistic of a field over the last revolution, a figure of a loop, or one of the user's.

    Attributes:
        topic, field: signal; for a loop the error that its controller sees, which is part of the digest; empty for a
            function.
        statistic: one of `STATISTICS`, or of `lathe_rc.judge.loops.FIGURES`; or a function ``package.module:name``.
        node: controller of the loop; empty for a signal.
    """

    topic: str
    field: str
    statistic: str
    node: str = ""

    @property
    def name(self) -> str:
        """Name of the measure's column."""
        if self.node:
            return f"{self.node}.{self.statistic}"
        return f"{self.topic}.{self.field}:{self.statistic}" if self.topic else self.statistic


def figures(scenario: Scenario) -> dict[str, Measure]:
    """Return the figures of a scenario's force and position loops, by column."""
    measures = [
        Measure(loop.topic, "error", figure, loop.node) for loop in loops(judged(scenario.nodes)) for figure in FIGURES
    ]
    return {each.name: each for each in measures}


def has_tool(scenario: Scenario) -> bool:
    """Return whether cells of a scenario have a form error."""
    return any(source.type == messages.TOOL for source in Cell(scenario.nodes).dense.values())


def unit(column: str, scenario: Scenario) -> tuple[float, str]:
    """Return the display unit of a column: the factor from SI units, and the unit's name."""
    node, _, name = column.rpartition(".")
    if not re.fullmatch(r"[\w/]*", node):  # a formula of columns
        return 1.0, ""
    loop = next((loop for loop in loops(judged(scenario.nodes)) if loop.node == node), None)
    if loop and name in FIGURES:
        told = FIGURES[name][1]
        return (1.0, told.removeprefix("1")) if told else (loop.quantity.scale, loop.quantity.unit)
    if name == "in_tolerance_from":
        return 1.0, "revolutions"
    return (1e6, "µm") if name.endswith("_error") else (1.0, "")


def measure(text: str, scenario: Scenario) -> Measure:
    """Parse a measure ``TOPIC.FIELD:STATISTIC``, ``NODE.FIGURE`` or ``package.module:function``.

    Raises:
        InputError: the topic, the field, the statistic or the figure is unknown, or the function cannot be imported.
    """
    of_loops = figures(scenario)
    if text in of_loops:
        return of_loops[text]
    place, colon, statistic = text.partition(":")
    topic, dot, field = place.removeprefix("/").rpartition(".")
    dense = Cell(scenario.nodes).dense
    if colon and topic not in dense and place.replace(".", "_").isidentifier():
        if find_spec(place.partition(".")[0]):  # otherwise it is rather a misspelt topic
            allowed_code.allow_named(text)
        if allowed_code.is_allowed(place) or not dot:
            function(text)
            return Measure("", "", text)
    if not colon or not dot:
        loop = f", or {instead(text, of_loops).removeprefix('allowed: ')}" if of_loops else ""
        raise InputError(f"measure {text!r}; allowed: TOPIC.FIELD:STATISTIC, such as coarse/state.effort:max{loop}")
    if topic not in dense:
        raise InputError(f"measure {text!r}: no topic {topic!r} in the cell; {instead(topic, dense)}")
    fields = messages.sample_fields(dense[topic].type)
    if field not in fields:
        raise InputError(f"measure {text!r}: no field {field!r} in {topic}; {instead(field, fields)}")
    if statistic not in STATISTICS:
        raise InputError(f"measure {text!r}: no statistic {statistic!r}; {instead(statistic, STATISTICS)}")
    return Measure(topic, field, statistic)


def function(name: str) -> Callable[[Recording], float]:
    """Return the function ``package.module:name`` of a recording to a number.

    Raises:
        InputError: there is no such function.
    """
    module, _, place = name.partition(":")
    if not allowed_code.is_allowed(module):
        package = module.partition(".")[0]
        raise InputError(f"measure {name}: code that is not allowed; allowed: {allowed_code.OPTION} {package}")
    found = attribute(module, place, f"measure {name}")
    if not callable(found):
        raise InputError(f"measure {name}: {shown(repr(found))}; allowed: a function of a recording to a number")
    return cast("Callable[[Recording], float]", found)


def schema(targets: Mapping[str, "Target"], carried: Sequence[str], measures: Sequence[Measure]) -> pa.Schema:
    """Return the Arrow schema of the rows of a sweep.

    Raises:
        InputError: a carried column has the name of another column.
    """
    columns = dict(HEAD)
    for name, target in targets.items():
        columns[name] = pa.list_(_ARROW[target.type]) if target.is_list else _ARROW[target.type]
    columns |= _FOUND | {each.name: pa.float64() for each in measures} | _TAIL
    if taken := [name for name in carried if name in columns]:
        raise InputError(f"{taken[0]}: carried along, and a column of each row as well; allowed: another name")
    columns |= dict.fromkeys(carried, pa.string())
    return pa.schema(list(columns.items()))


def effective(scenario: Scenario, targets: Sequence[str]) -> dict[str, Value]:
    """Return the values of a cell's parameters, by target; none for an element that its list does not have."""
    found = {}
    for target in targets:
        with contextlib.suppress(IndexError):
            found[target] = scenario.value(target)
    return found


class _Keeper(Errors):
    """Sink that collects the form error, the limited nodes, and the measured signals of a run."""

    def __init__(self, cell: Cell, samples: int, measures: Sequence[Measure]) -> None:
        parameters = {name: stage.shared for name, stage in cell.stages.items()}
        tool = next((topic for topic, source in cell.dense.items() if source.type == messages.TOOL), "")
        self._tolerances = Tolerances.of(judged(parameters), f"/{tool}")
        super().__init__(cell, samples, self._tolerances.zones)
        if self._tolerances.tolerance:
            self._tolerances = replace(self._tolerances, doubt=form_doubt(parameters))
        self._first = cell.first
        self._events = [topic for topic, source in cell.sparse.items() if source.type == messages.EVENT]
        self._functions = [each.statistic for each in measures if not each.topic]
        self._whole = Topics(cell, samples, [*cell.dense, *cell.sparse]) if self._functions else None
        measures = [each for each in measures if each.topic]
        self.heard = [*self.heard, *self._events, *(f"{asked.topic}.{asked.field}" for asked in measures)]
        asked_of = {asked.node for asked in measures}
        tables = {name: stage.shared for name, stage in cell.stages.items() if name in asked_of}
        self._loops = watches(loops(judged(tables)), {topic: source.type for topic, source in cell.dense.items()})
        self.heard += [f"{watch.topics[1]}.{field}" for watch in self._loops for field in ("set_point", "command")]
        if self._whole:
            self.heard = self._whole.heard
        self._limited: set[str] = set()
        self._measures = measures
        # The digest of a cell without a tool is that of what is measured.
        self._signals = {
            (each.topic, each.field): np.empty(samples) for each in measures if not (each.node and self.form.tool)
        }
        self._turns = RunningErrors()  # a cell without a tool has no form error, but revolutions all the same
        self._hash = xxhash.xxh3_128()

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Collect a chunk of samples (implements `lathe_rc.cell.engine.Sink`)."""
        super().chunk(first, samples, dense, sparse)
        if self._whole:
            self._whole.chunk(first, samples, dense, sparse)
        for topic, said in sparse.items():
            if topic in self._events and any(parse(message.values["action"]).verb in LIMITS for message in said):
                self._limited.add(topic.removesuffix("/events"))
        if self.form.tool:
            self._hash.update(_bytes(dense[self.form.tool]["error"]))
        elif self._measures and self.form.encoder:
            angle = dense[self.form.encoder]["angle_true"]
            if first == self._first > 0:
                self._turns = RunningErrors(turns_before(angle, first))
            self._turns.add(angle, angle)
        for (topic, field), kept in self._signals.items():
            kept[first - self._first :][:samples] = dense[topic][field]
        for watch in self._loops:
            watch.chunk(first, samples, dense, sparse)

    def row(self, errors: FormErrors) -> dict[str, Any]:
        """Return the result columns of a completed run.

        Raises:
            LatheError: a function of the recording has no finite value.
        """
        starts = (errors if self.form.tool else self._turns.found()).starts
        last = slice(*starts[-2:]) if starts.size > 1 else slice(None)  # all, without a complete revolution
        found: dict[str, Any] = {
            "limits": ", ".join(sorted(self._limited)),
            "revolutions": errors.rms.size,
            "digest": _told(self._hash) if self.form.tool else _digest(list(self._signals.values())),
        }
        results = {watch.loop.node: watch.result() for watch in self._loops}
        for each in self._measures:
            if not each.node:
                found[each.name] = STATISTICS[each.statistic](self._signals[each.topic, each.field][last])
            elif (result := results[each.node]).found.errors.rms.size and not result.why:
                found[each.name] = FIGURES[each.statistic][0](result)
        if errors.rms.size and not self.form.soundness.why:
            for name, values in (("max", errors.largest), ("rms", errors.rms)):
                found |= {f"tool.first_{name}_error": values[0], f"tool.{name}_error": values[-1]}
                found[f"tool.{name}_errors"] = values
        if self._whole:
            recording = self._whole.kept()
            for name in self._functions:
                found[name] = value = float(function(name)(recording))
                if not math.isfinite(value):
                    raise LatheError(f"{name} is {value}; allowed: a finite number")
        if not self.form.soundness.why and (verdict := self._tolerances.verdict(self.form)):
            found["tool.in_tolerance_from"] = verdict.since or None
        return found


def digest(recording: Recording, measures: Sequence[Measure]) -> str | None:
    """Return the digest of a recording; it equals the digest in the cell's row for bit-identical results.

    It is XXH3 (128 bits) of all samples of the form error, little-endian; for a cell without a tool, of the measured
    signals; None if there are neither. It takes 5 % of the time of SHA-256.
    """
    if messages.TOOL in (recording.types[topic] for topic in recording.dense):
        return _digest([recording.of_type(messages.TOOL)["error"]])
    signals = dict.fromkeys((messages.full(each.topic), each.field) for each in measures if each.topic)
    return _digest([recording.dense[topic][field] for topic, field in signals])


def _digest(kept: Sequence[Samples]) -> str | None:
    found = xxhash.xxh3_128()
    for samples in kept:
        found.update(_bytes(samples))
    return _told(found) if kept else None


def _told(found: xxhash.xxh3_128) -> str:
    return f"xxh3:{found.hexdigest()}"


def _bytes(samples: Samples) -> memoryview:
    return samples.astype("<f8", copy=False).data  # a copy is made only on a big-endian machine


def compute(
    base: Scenario,
    values: Mapping[str, Value],
    targets: Sequence[str],
    measures: Sequence[Measure],
    bench: CellRunner | None = None,
) -> dict[str, Any]:
    """Run a cell and return its row without number and key; an error is stored as the row's status and reason.

    Args:
        base: the varied scenario.
        values: the cell's values, by target.
        targets: varied parameters that have columns.
        measures: further columns.
        bench: runner shared by similar cells; None: a new one.
    """
    start = time.perf_counter()
    row: dict[str, Any] = {"status": DONE, "version": revision()}
    row |= {target: values[target] for target in targets if target in values}
    bench = bench or CellRunner()
    cell: Cell | None = None
    started = False
    try:
        scenario = base.varied(values)
        row |= effective(scenario, targets)
        row["seed"] = scenario.shared.seed
        cell = bench.cell(scenario)
        cell.check(cures=False)
        keeper = _Keeper(cell, cell.samples - cell.first, measures)
        started = True  # from here on an InputError is a failure of the run, not of the check
        row |= keeper.row(bench.run(cell, keeper)) | {"samples": cell.samples - cell.first}
    except LatheError as error:
        refused = isinstance(error, InputError) and not started
        row["status"] = REFUSED if refused else DIVERGED if isinstance(error, DivergedError) else FAILED
        row["reason"] = str(error)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - third-party code can raise anything
        frames = traceback.extract_tb(error.__traceback__)
        last = next((frame for frame in reversed(frames) if "site-packages" not in frame.filename), frames[-1])
        row["status"] = FAILED
        row["reason"] = f"{type(error).__name__} in {Path(last.filename).name}, line {last.lineno}: {shown(error)}"
    if cell is not None and cell.factors:
        row["margin"] = 1.0 - max(cell.factors.values())
    if cell is not None and (margins := cell.drive_margins):
        row["drive_margin"] = min(margins.values()).error
    row["seconds"] = time.perf_counter() - start
    return row


@cache
def revision() -> str:
    """Return the version and, in a checkout, the commit of lathe_rc, such as ``0.1.0`` or ``0.1.0+93c5a79``.

    The suffix ``-dirty`` marks files that differ from the commit.
    """
    folder = Path(__file__).parents[2]
    if (folder / ".git").exists():
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            asked = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude=*"]
            told = subprocess.run(asked, capture_output=True, check=True, text=True).stdout.strip()
            return f"{__version__}+{told}"
    return __version__
