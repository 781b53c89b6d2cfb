# SPDX-License-Identifier: Apache-2.0
"""Many cells at once: each gets the bits that it gets alone, and one that fails is reported."""

import gc
import itertools
import random
import sys
import weakref
from functools import cache, cached_property

import numpy as np
import pytest
from cells import every_scenario
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from machines import line_of

from lathe_rc import harness
from lathe_rc.blocks.ports import Output
from lathe_rc.cell import batch, scenario
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.scenario import new_stage
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.stage_cache import Start, UnknownPartError
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import COMMAND


def load(name, revolutions, *overrides):
    return scenario.load(name, [f"spindle_encoder.revolutions={revolutions}", *overrides])


#: variations of two channels that leave different things behind them, by what comes of them
KINDS = {
    "plain": {},
    "noise": {"electrodynamic_actuator.noise_rms": 1e-7, "seed": 3},
    "events": {"fine_controller.events": ["revolution 1: freeze", "revolution 2: clear"]},
    "limit": {"electrodynamic_actuator.command_stroke": 50e-6},
    "faults": {"allow_faults": True, "tool.faults": ["revolution 1 to 2: coarse/state.position stuck"]},
    "other drive": {"electrodynamic_actuator.damping": 0.7},
    "other piezo": {"piezo_actuator.hysteresis": "bouc_wen", "piezo_actuator.stroke": 4e-6},
    "other law": {"fine_controller.join_below": 1e-6, "learning_controller.identify": False},
    "coarse encoder": {"spindle_encoder.counts_per_revolution": 20_000},
    "block": {"block_size": 128},
    "refused": {"learning_controller.lead_time": 3e-3},
    "not finite": {"electrodynamic_actuator.noise_rms": 1e308},
    "stopped": {"learning_controller.stop_ratio": 1e-6},
}
TOPICS = ["encoder", "tool", "fine/command", "coarse/learning", "learning_controller/events"]


def why(error):
    """The reason of a refusal, without the cures that a batch does not look for."""
    return str(error).partition("; allowed")[0]


@cache
def alone(kind):
    """The digests of a run of the cell alone, or why it failed."""
    try:
        digest = harness.run(load("two_channel", 3).varied(KINDS[kind])).digest
    except LatheError as error:
        return why(error)
    return {f"/{topic}": digest[f"/{topic}"] for topic in sorted(TOPICS)}


# Without shrinking: a run takes a while.
@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(st.lists(st.sampled_from(sorted(KINDS)), min_size=3, max_size=8), st.booleans(), st.sampled_from([1, 3]))
def test_each_cell_has_the_digests_that_it_has_alone_whatever_ran_before(kinds, named, threads):
    """In any order, also after cells that were refused, have diverged or failed, and whether or not stages are kept."""
    base = load("two_channel", 3)
    base = base.named() if named else base
    scenarios = [base.varied(KINDS[kind]) for kind in kinds]
    outcomes = batch.run_many(scenarios, TOPICS, threads=threads)
    for kind, cell, outcome in zip(kinds, scenarios, outcomes, strict=True):
        assert outcome.scenario is cell
        assert (why(outcome.error) if outcome.error else outcome.kept.digests()) == alone(kind)


@pytest.mark.parametrize("path", every_scenario())
def test_stages_of_all_kinds_are_set_back(path):
    """A cell that runs again and again on a runner gives the same, though its stages are made once or twice."""
    runner, told, stages = batch.CellRunner(), [], []
    described = load(path, 2)
    for _ in range(4):
        cell = runner.cell(described)
        cell.check()
        told.append(runner.run(cell, batch.Topics(cell, cell.samples, [*cell.dense, *cell.sparse])).digests())
        stages.append(cell.stages)
    assert told[0] == dict(harness.run(described).digest)
    assert told[1:] == told[:1] * 3
    assert all(stages[1][name] is stages[3][name] for name in stages[0]), "they are kept"


def test_errors_are_those_of_a_run():
    scenarios = [load("piston", 5), load("full_cell", 3), load("interrupted_cut", 3)]
    for outcome in batch.run_many(scenarios):
        alone = harness.run(outcome.scenario).errors
        for name in ("rms", "largest", "peak_to_valley", "starts"):
            assert np.array_equal(getattr(outcome.kept, name), getattr(alone, name))
    assert outcome.kept.rms.size == 0, "it has no tool"


def test_what_no_run_has_changed_is_left_alone_when_a_stage_is_set_back():
    """Stages that run in other threads may read it: types of memories were empty for a moment, and cells failed."""
    stage = new_stage("learning_controller", load("piston", 3).nodes["learning_controller"])
    stage.read_by_all, stage.own = {"a": 1, "b": 2}, {"c": 3}
    start, sizes = Start(stage), set()
    stage.own["d"] = 4
    sys.setprofile(lambda *_: sizes.add(len(stage.read_by_all)))
    try:
        start.rewind()
    finally:
        sys.setprofile(None)
    assert sizes == {2}
    assert stage.own == {"c": 3}


class Field:
    """Keeps a field of the tool, and looks at another."""

    heard = ("tool.error",)

    def __init__(self, looked_at=""):
        self.pieces, self.looked_at = [], looked_at

    def chunk(self, first, samples, dense, sparse):
        assert ([*dense], [*dense["tool"]]) == (["tool"], ["error"])
        self.pieces.append(dense["tool"]["error"].copy())
        if self.looked_at:
            topic, _, name = self.looked_at.partition(".")
            dense[topic][name]

    def kept(self):
        return np.concatenate(self.pieces)


def test_what_is_asked_for_is_kept_of_a_run_and_nothing_else():
    piston = load("piston", 3)
    runner = batch.CellRunner()
    kept = runner.run(runner.cell(piston), Field())
    assert np.array_equal(kept, harness.run(piston).recording.dense["/tool"]["error"])
    for looked_at, told in (("tool.reference", "tool.reference"), ("encoder.angle", "encoder")):
        with pytest.raises(KeyError, match=f"{told} is not kept: `heard` of the sink has to name it"):
            runner.run(runner.cell(piston), Field(looked_at))


def test_a_cell_that_cannot_work_is_an_outcome_and_the_others_go_on():
    changes = [{}, KINDS["refused"], KINDS["not finite"], {"spindle_encoder.revolutions": 0.0}, {}]
    good, refused, diverged, endless, again = batch.run_many(map(load("piston", 3).varied, changes))
    assert np.array_equal(good.kept.rms, again.kept.rms)
    assert isinstance(refused.error, InputError)
    assert "learning diverges" in str(refused.error)
    assert isinstance(diverged.error, LatheError)
    assert "/coarse/state: " in str(diverged.error)
    assert "needs an end" in str(endless.error)
    assert refused.kept is diverged.kept is endless.kept is None


def test_cells_are_made_when_their_turn_comes():
    piston, asked = load("piston", 1), itertools.count()
    outcomes = batch.run_many((piston.varied({"seed": next(asked)}) for _ in range(1000)), batch.Errors, threads=2)
    assert [next(outcomes).scenario.shared.seed for _ in range(3)] == [0, 1, 2]
    outcomes.close()
    assert next(asked) < 20


@pytest.mark.parametrize("name", ["two_channel", "full_cell", "supervised_turning", "series"])
def test_a_cell_is_gone_when_nobody_holds_it(name):
    """Without the collector of cycles: in a batch of thousands they would pile up."""
    cell = Cell(load(name, 1).nodes)
    engine = Engine(cell)
    engine.run([])
    left = [weakref.ref(stage) for stage in cell.stages.values()]
    gc.disable()
    try:
        del cell, engine
        assert [alive for each in left if (alive := each()) is not None] == []
    finally:
        gc.enable()


def test_a_topic_that_is_not_there_is_named():
    (outcome,) = batch.run_many([load("piston", 1)], ["tool", "fine/state"])
    assert str(outcome.error).startswith("no topic 'fine/state' in the cell; did you mean coarse/state?")


# --- stages that are set back: all that a run changes of them, and what nobody can set back is not tried


class Part:
    """Something that a stage may hold."""

    def __init__(self):
        self.samples, self.said, self.known, self.seen = np.arange(3.0), [1], {"a": [2]}, {3}
        self.draws = np.random.default_rng(5)
        self.stage = None

    @cached_property
    def total(self):
        return float(self.samples.sum())

    def run(self):
        """Change all of it."""
        self.samples += 1.0
        self.known["a"].append(int(self.samples[0]))
        self.known["b"] = self.said
        self.said.append(self.draws.random())
        self.said, self.late = [*self.said, len(self.seen)], True
        self.seen.clear()
        return self.samples.tolist(), self.said, repr(self.known)


class Holding(Stage):
    """A stage with a part, which knows its stage."""

    kind = "holding"
    Parameters = NodeParameters

    def __init__(self, part):
        super().__init__("holding", NodeParameters.read("holding", {}))
        self.part, self.parts, self.work = part, (part, {"part": part}), part.run if isinstance(part, Part) else None
        if isinstance(part, Part):
            part.stage = self
        self.declare(outputs=[Output("half", COMMAND)])


def test_everything_that_hangs_on_a_stage_is_set_back():
    stage = Holding(Part())
    before = stage.part.total
    start = Start(stage)
    first = stage.part.run()
    stage.part, stage.more = None, 1
    start.rewind()
    assert not hasattr(stage, "more")
    assert not hasattr(stage.part, "late")
    assert stage.part.total == before
    assert stage.part.run() == first


HIDDEN = [random.Random(1), iter([1]), (each for each in "ab"), np.array([{}]), bytearray(b"ab"), {}.items()]  # noqa: S311


@pytest.mark.parametrize("part", HIDDEN)
def test_what_cannot_be_set_back_is_not_tried(part):
    with pytest.raises(UnknownPartError):
        Start(Holding(part))


# --- variations of a scenario


class TestVaried:
    """`Scenario.varied` gives what `load` gives with the same overrides."""

    @pytest.mark.parametrize(
        "changes",
        [
            {"tool.profile_file": "profiles/piston.csv", "tool.profile": "csv", "spindle_encoder.revolutions": 7},
            {"seed": 3, "block_size": 128},
            {"run_id": "mine"},
        ],
    )
    def test_is_what_the_file_with_overrides_says(self, changes):
        loaded = load("piston", 5, *(f"{name}={value}" for name, value in changes.items()))
        assert load("piston", 5).varied(changes) == loaded

    def test_a_given_run_id_stays(self):
        assert load("piston", 5, "run_id=mine").varied({"seed": 3}).shared.run_id == "mine"

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"tol.feed": 1.0}, "tol.feed: no node 'tol' in the scenario; did you mean tool?"),
            ({"feed": 1.0}, "feed: 'feed' is not shared; did you mean tool.feed?"),
            ({"tool.fed": 1.0}, "tool.fed: unknown parameter; did you mean feed?"),
            ({"tool.feed": -1.0}, "tool.feed = -1.0; allowed: "),
            ({"tool.seed": 4}, "tool.seed = 4: other nodes have 0; "),
        ],
    )
    def test_what_cannot_be_is_refused(self, changes, words):
        refusal = line_of(lambda: load("piston", 5).varied(changes))
        assert words in refusal
