# SPDX-License-Identifier: Apache-2.0
"""Checkpoint: the state of a whole cell at a sample, in a file from which runs go on.

The state consists of what the run has changed in each stage (`lathe_rc.cell.changes`) and of the samples that delayed
readers still need. A run that goes on with the same parameters gives the same bits as the uninterrupted one. Other
parameters take effect at the checkpoint; those that the state depends on, such as the size of a memory, are rejected.

The file is one of plain data (`lathe_rc.data_file`): it contains no code.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import __version__, data_file
from lathe_rc.cell.changes import Change, ClashError, Restoring, changes
from lathe_rc.cell.events import Trigger
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.parameters import NodeParameters, remapped_by
from lathe_rc.cell.scenario import HOST_PARAMETERS, Scenario, kind_of, new_stage
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.time_master import START_FROM, TimeMaster, TimeMasterParameters
from lathe_rc.errors import InputError, shown
from lathe_rc.extensions import is_ours, source_hash
from lathe_rc.files import written
from lathe_rc.jit import SOURCES
from lathe_rc.messages import Signals

_KIND = "checkpoint"
_WHEN = re.compile(r"(revolution|second|sample):([0-9.eE+-]+)")
_FREE = frozenset({"revolutions", "events", "faults", "block_size", "joint_state_period", "allow_faults"})


@dataclass(frozen=True)
class Checkpoint:
    """State of a cell after all samples before ``sample``.

    Attributes:
        scenario: name of the scenario.
        identity: hash of everything that affects its run (`Scenario.identity`).
        made_with: versions of the code that determine the layout of the state, by module.
        sample: number of samples computed.
        nodes: kind and parameters of each node.
        stages: what the run has changed in each stage.
        past: samples before ``sample`` that delayed readers need, by relative topic and field.
        path: the file it was read from.
    """

    scenario: str
    identity: str
    made_with: Mapping[str, str]
    sample: int
    nodes: Mapping[str, tuple[str, Mapping[str, Any]]]
    stages: Mapping[str, Change | None]
    past: Mapping[str, Signals]
    path: Path = Path()
    _starts: dict[str, Stage] = field(default_factory=dict, compare=False, repr=False)

    def check(self, stages: Iterable[str], master: TimeMaster) -> None:
        """Check that a cell has the nodes of the checkpoint, and runs longer.

        Raises:
            InputError: it does not.
        """
        if other := {*stages} ^ self.nodes.keys():
            raise InputError(
                f"{self.path} holds the nodes {', '.join(self.nodes)}, and {', '.join(sorted(other))} is missing here "
                "or there; allowed: the same nodes"
            )
        if (master.samples or math.inf) <= self.sample:
            raise InputError(
                f"{self.path} is the state at sample {self.sample}, and the run ends at {master.samples}; "
                "allowed: a longer run (revolutions)"
            )

    def check_versions(self, kinds: Iterable[str]) -> None:
        """Check that the code on which the states of some kinds of stages depend is that of the checkpoint.

        Raises:
            InputError: it is not.
        """
        for module, here in _made_with(kinds).items():
            if (made := self.made_with.get(module, "none")) != here:
                raise InputError(
                    f"{self.path}: made with {module} {shown(made)}, this is {here}; allowed: the same version (make "
                    "it anew)"
                )

    def stage(self, name: str, table: NodeParameters) -> Stage:
        """Return a new stage with the state of the checkpoint.

        Args:
            name: name of its node.
            table: its parameters; tunable parameters are changed as by an event ``set``.

        Raises:
            InputError: the checkpoint has no such node, or its state depends on a parameter that differs.
        """
        if name not in self.nodes:
            raise InputError(f"{self.path} holds no node {name}; allowed: the same nodes, {', '.join(self.nodes)}")
        before = self.nodes[name][1]
        stage = new_stage(name, table)
        differing = self._differing(name, stage)
        if tuned := differing & {*stage.tunable}:
            stage = new_stage(name, table.changed(name, {key: before[key] for key in tuned}))
        start = self._start(name, table, differing) if differing - tuned else None
        try:
            Restoring(start).restore(self.stages[name], stage)
        except ClashError as error:
            told = ", ".join(f"{name}.{key} = {before[key]}" for key in sorted(differing - tuned))
            raise InputError(
                f"{self.path}: the state of {name} depends on what differs here ({error}); allowed: as in the "
                f"checkpoint, {told}"
            ) from None
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(f"{self.path}: not the state of {name} ({shown(error)}); make it anew") from None
        if differing - tuned:
            stage.forget()
        if tuned:
            stage.shared = table
            stage.parameters = stage.parameters.changed(name, {key: getattr(table, key) for key in tuned})
            stage.tune(stage.parameters)
        return stage

    def _differing(self, name: str, stage: Stage) -> set[str]:
        """Return the parameters of a node that differ from the checkpoint's and affect its samples."""
        (kind, before), table = self.nodes[name], stage.shared
        if kind != (now := kind_of(name, table.stage)):
            raise InputError(f"{name} is {now}, and in {self.path} {kind}; allowed: {kind}")
        values = _values(table)
        if values.keys() != before.keys():
            raise InputError(f"{self.path}: not the state of {name} (other parameters); make it anew")
        differing = {key for key, value in values.items() if value != before[key]}
        # Nodes announce the rules that concern their topics, sorted.
        if all(remapped_by(table.remap, topic) == remapped_by(before["remap"], topic) for topic in stage.topics):
            differing.discard("remap")
        fixed = differing - _FREE if isinstance(table, TimeMasterParameters) else set[str]()
        fixed |= {key for key in differing if type(table).rows()[key].named is not None or key == "remap"}
        if fixed:
            told = ", ".join(f"{name}.{key} = {before[key]}" for key in sorted(fixed))
            raise InputError(f"{self.path}: goes on only with the parameters of the checkpoint; allowed: {told}")
        return differing

    def _start(self, name: str, table: NodeParameters, differing: set[str]) -> Stage:
        """Return the stage as it was created for the run of the checkpoint."""
        if name not in self._starts:
            before, rows = self.nodes[name][1], type(table).rows()
            given = {key: before[key] for key in differing if not rows[key].is_file}
            self._starts[name] = new_stage(name, type(table).read(name, {**table.model_dump(), **given}))
        return self._starts[name]


def _values(table: NodeParameters) -> dict[str, Any]:
    return table.model_dump(mode="json", exclude={*HOST_PARAMETERS, *table.judging, START_FROM, "stage"})


def take(scenario: Scenario, stages: Mapping[str, Stage], sample: int, past: Mapping[str, Signals]) -> Checkpoint:
    """Return a checkpoint of the running stages of a scenario.

    Args:
        scenario: the scenario of the run.
        stages: its stages, which have computed all samples before ``sample``.
        sample: number of samples computed.
        past: samples that delayed readers need.

    Raises:
        LatheError: a third-party stage contains something that is not data.
    """
    nodes = {name: (kind_of(name, stage.shared.stage), _values(stage.shared)) for name, stage in stages.items()}
    told: dict[str, Change | None] = {}
    for name, stage in stages.items():
        with stage.named():
            told[name] = changes(stage, new_stage(name, stage.shared))
    return Checkpoint(
        scenario.name,
        scenario.identity,
        _made_with(kind for kind, _ in nodes.values()),
        sample,
        nodes,
        told,
        past,
    )


def sample_of(when: str, master: TimeMaster) -> int:
    """Return the number of samples before a point of time, written as revolution:R, second:T or sample:N.

    For a revolution, the last sample before the angle is the first that the next run computes, so that its first
    revolution is complete.

    Raises:
        InputError: the text has another form, or the point of time is not within the run.
    """
    match = _WHEN.fullmatch(when.strip())
    try:
        value = float(match[2]) if match else math.nan
    except ValueError:
        value = math.nan
    if match is None or not 0.0 <= value < math.inf:
        raise InputError(f"checkpoint at {shown(when)!r}; allowed: revolution:R, second:T or sample:N")
    if match[1] == "revolution":
        found = master.sample_at(2.0 * np.pi * value) - 1
    else:
        found = Trigger(match[1], value, "", "").sample(master.shared.sample_rate)
    if not 0 < found <= (master.samples or 0):
        raise InputError(f"checkpoint at {when}: sample {found}; allowed: from sample 1 to the end, {master.samples}")
    return found


# ---- the file ------------------------------------------------------------------------------------------------------


def _made_with(kinds: Iterable[str]) -> dict[str, str]:
    """Return the versions of the code on which the layout of a state depends."""
    others = {STAGES[kind].__module__ for kind in kinds}
    return {
        "lathe_rc": f"{__version__}+{SOURCES}",
        **{module: source_hash(module) for module in sorted(others) if not is_ours(module)},
    }


def save(path: Path, found: Checkpoint) -> None:
    """Write a checkpoint to a file, which it replaces atomically.

    Raises:
        InputError: the file cannot be written.
    """
    told = {
        "made_with": found.made_with,
        "scenario": found.scenario,
        "identity": found.identity,
        "sample": found.sample,
        "nodes": found.nodes,
        "past": found.past,
        "stages": found.stages,
    }
    with written(path) as file:
        file.write(data_file.packed(_KIND, told))


def begun_of(nodes: Mapping[str, NodeParameters]) -> Checkpoint | None:
    """Return the checkpoint that the time master of some nodes names; None without one.

    Raises:
        InputError: see `load`, or the file was made by another version of the code of these nodes.
    """
    path = next(filter(None, (getattr(table, START_FROM, "") for table in nodes.values())), "")
    if not path:
        return None
    try:
        found = _loaded(path, Path(path).stat().st_mtime_ns)
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be read ({error.strerror})") from None
    found.check_versions({kind_of(name, table.stage) for name, table in nodes.items()} & {*STAGES})
    return found


@lru_cache(maxsize=4)
def _loaded(path: str, changed: int) -> Checkpoint:  # noqa: ARG001 - the time is part of the key
    return load(Path(path))


def load(path: Path) -> Checkpoint:
    """Read a checkpoint written by `save`.

    Raises:
        InputError: the file cannot be read, is no checkpoint, is damaged, or was made by another version of lathe_rc.
    """
    found = data_file.read(path, _KIND, partial(_made, path))
    found.check_versions(())
    return found


def _made(path: Path, told: Any) -> Checkpoint:
    """Return the checkpoint with the content of a file."""
    nodes = {name: (kind, dict(values)) for name, (kind, values) in told["nodes"].items()}
    made, sample = dict(told["made_with"]), int(told["sample"])
    return Checkpoint(told["scenario"], told["identity"], made, sample, nodes, told["stages"], told["past"], path)
