# SPDX-License-Identifier: Apache-2.0
"""Error budget of a scenario: contributions to the form error, determined by runs with causes switched off."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from lathe_rc import messages
from lathe_rc.analysis.budget import TOLD, Budget, Causes, Decomposition
from lathe_rc.analysis.metrology import evenly
from lathe_rc.analysis.tolerance import LAST, growth
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell import batch
from lathe_rc.cell.parameters import Value, Values
from lathe_rc.cell.scenario import Scenario, of_load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.judge.causes import EVERYWHERE, PREFIXES
from lathe_rc.messages import Samples, Signals
from lathe_rc.signals.form_errors import form_errors

_TURN = 2.0 * np.pi
_FIRST = ("Q floor", "model", "speed", "lead", "feed")  # causes in the order of a budget, before those of parameters
_NEEDS = {"lead": "speed"}  # cause without which another has no effect


@dataclass(frozen=True)
class Cause:
    """Cause of form error that can be switched off.

    Attributes:
        off: parameter values that switch the cause off, by NODE.PARAM.
        needs: another cause without which this one has no effect; empty if there is none.
    """

    off: Values
    needs: str = ""


@dataclass(frozen=True)
class _Tail:
    """Last revolutions of a run.

    Attributes:
        whole: number of complete revolutions in the run.
        error: form error at equally spaced angles [m], shape (revolutions, points).
        height: height of the tool along the part [m], shape (samples,).
        largest: largest form error of each revolution of the run [m], shape (revolutions,).
    """

    whole: int
    error: Samples
    height: Samples
    largest: Samples


class _Keep:
    """Keeper of the last revolutions of a run (see `lathe_rc.cell.batch.Keeper`)."""

    def __init__(self, cell: Cell, samples: int) -> None:
        named = {source.type: topic for topic, source in reversed(cell.dense.items())}
        if not {messages.ENCODER, messages.TOOL} <= named.keys():
            raise InputError("no form error to budget: the cell has no encoder and tool; allowed: a scenario with both")
        encoder, tool = named[messages.ENCODER], named[messages.TOOL]
        self._fields = {"angle": (encoder, "angle_true"), "error": (tool, "error"), "height": (tool, "height")}
        self.heard: Collection[str] = [".".join(place) for place in self._fields.values()]
        self._kept = {name: np.empty(samples) for name in self._fields}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Process a chunk of the run, as a sink of the engine."""
        for name, (topic, of) in self._fields.items():
            self._kept[name][first : first + samples] = dense[topic][of]

    def kept(self) -> _Tail:
        """Return the last complete revolutions of the run."""
        angle = self._kept["angle"]
        if angle.size < 2:
            return _Tail(0, np.empty((0, 0)), angle, angle)
        # Keep one revolution more than reported, for the spline; the last one may lack two samples.
        before = max(int((angle[-1] + 2.0 * (angle[-1] - angle[-2])) / _TURN) - LAST - 1, 0)
        begin = int(np.searchsorted(angle, before * _TURN))
        error = evenly(angle[begin:] - before * _TURN, self._kept["error"][begin:])
        largest = form_errors(angle, self._kept["error"]).largest
        return _Tail(before + error.shape[0], error[-LAST:], self._kept["height"][begin:], largest)


def _not_yet(scenario: Scenario, values: Values) -> dict[str, Value]:
    """Return the values that differ from those of the scenario."""
    parts = {target: target.partition(".") for target in values}
    return {t: v for t, v in values.items() if getattr(scenario.nodes[parts[t][0]], parts[t][2]) != v}


def _simple(scenario: Scenario) -> dict[str, Cause]:
    """Return the causes that fixed parameter values switch off."""
    names = dict.fromkeys([*EVERYWHERE, *(name for table in scenario.nodes.values() for name in table.causes)])
    return {
        name: Cause(
            {
                f"{node}.{prefix}{each}": value
                for node, table in scenario.nodes.items()
                for prefix in PREFIXES
                for each, value in table.causes.get(name, EVERYWHERE.get(name, {})).items()
                if f"{prefix}{each}" in type(table).model_fields
            }
        )
        for name in names
    }


def _of_cell(scenario: Scenario, height: Samples) -> tuple[dict[str, Cause], dict[str, str]]:
    """Return the causes that nodes and stages find in this cell; and those that stay, with the reasons."""
    cell = Cell(scenario.nodes)
    found: list[tuple[str, Mapping[str, Values | str]]] = []
    found += [(node, stage.causes_off(cell)) for node, stage in cell.stages.items()]
    found += [(node, table.causes_off(node, scenario.nodes, height)) for node, table in scenario.nodes.items()]
    off: dict[str, dict[str, Value]] = {name: {} for name in _FIRST}
    left_out: dict[str, str] = {}
    for node, each in found:
        for name, values in each.items():
            if isinstance(values, str):
                left_out[name] = values
            else:
                off.setdefault(name, {}).update({f"{node}.{parameter}": value for parameter, value in values.items()})
    return {name: Cause(off[name], _NEEDS.get(name, "")) for name in off if name not in left_out}, left_out


def causes(scenario: Scenario, height: Samples) -> tuple[dict[str, Cause], dict[str, str]]:
    """Return the causes that can be switched off in a scenario.

    Args:
        scenario: a valid scenario.
        height: height of the tool along the part in the reported revolutions [m].

    Returns:
        The causes, each after its prerequisite; and the causes that cannot be switched off, with the reasons.
    """
    found, left_out = _of_cell(scenario, height)
    found |= _simple(scenario)
    kept: dict[str, Cause] = {}
    for name, cause in found.items():
        off = _not_yet(scenario, cause.off)
        if not off or cause.needs not in ("", *kept):
            continue
        try:
            Cell(scenario.varied(off).nodes).check(cures=False)
        except InputError as error:
            left_out[name] = str(error)
        else:
            kept[name] = Cause(off, cause.needs)
    return kept, left_out


def _with(scenario: Scenario, found: Mapping[str, Cause], acting: Causes) -> Scenario:
    """Return the scenario with only some causes active; causes that need an inactive one are left unchanged."""
    off: dict[str, Value] = {}
    for name, cause in found.items():
        if name not in acting and (not cause.needs or cause.needs in acting):
            off |= cause.off
    return scenario.varied(off)


def _compared(scenario: Scenario, runs: Mapping[Causes, _Tail]) -> dict[Causes, Samples]:
    """Return the form errors of the runs, provided that all cover the same revolutions."""
    if len({tail.whole for tail in runs.values()}) > 1:
        (master,) = scenario.masters
        raise InputError(
            f"budget of {scenario.name}: its runs end with another revolution each, a sample or two before it is "
            f"complete; allowed: a whole number of {master}.revolutions"
        )
    return {acting: tail.error for acting, tail in runs.items()}


def budget(
    scenario: Scenario, *, threads: int | None = None, watch: Callable[[int, int], None] | None = None
) -> Budget:
    """Return the error budget of a scenario in its last ten revolutions (see `lathe_rc.analysis.budget`).

    The scenario runs offline, as a batch, with one cause after another switched off: about 10 runs, or 30 if causes
    interact.

    Args:
        scenario: scenario with all causes active; its spindle must have a number of revolutions.
        threads: number of computing threads; None: one per core.
        watch: called after each run with the number of completed runs and the known total.

    Raises:
        InputError: the scenario is invalid, or it has no tool or no complete revolution.
        LatheError: a run failed.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=60"])
        >>> for found in lathe_rc.budget(piston).causes:
        ...     print(f"{found.name}: {found.percent()} %")
        Q floor: -0.3 %
        speed: 83.5 %
        lead: 0.0 %
        feed: 16.9 %
    """
    scenario, done = of_load(scenario), 0

    def run(sets: Iterable[Causes], made: Mapping[str, Cause]) -> dict[Causes, _Tail]:
        nonlocal done
        order = sorted(sets, key=sorted)
        known = done + len(order)
        outcomes = batch.run_many((_with(scenario, made, acting) for acting in order), _Keep, threads=threads)
        tails: dict[Causes, _Tail] = {}
        for acting, outcome in zip(order, outcomes, strict=True):
            done += 1
            if watch is not None:
                watch(done, known)
            if outcome.error is not None:
                without = ", ".join(name for name in made if name not in acting)
                about = f"budget of {scenario.name} without {without}: " if without else ""
                kind = InputError if isinstance(outcome.error, InputError) else LatheError
                raise kind(f"{about}{outcome.error}")
            assert outcome.kept is not None, "it has not failed"
            tails[acting] = outcome.kept
        return tails

    (whole,) = run([frozenset()], {}).values()
    if not whole.error.size:
        raise InputError(f"budget of {scenario.name}: no complete revolution; allowed: a longer run")
    found, left_out = causes(scenario, whole.height)
    split = Decomposition({name: cause.needs for name, cause in found.items()})
    runs = {frozenset(found): whole}
    runs |= run(split.alone() - runs.keys(), found)
    told = split.split(_compared(scenario, runs), left_out)
    if abs(told.interactions.share) >= TOLD:
        runs |= run(split.together() - runs.keys(), found)
        told = split.split(_compared(scenario, runs), left_out)
    return replace(told, growth=growth(whole.largest))
