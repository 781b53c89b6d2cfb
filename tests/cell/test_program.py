# SPDX-License-Identifier: Apache-2.0
"""The program of a cell and its tapes: what is read late is the past, and Python is asked where it is needed."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lathe_machine.stages.spindle.spindle_encoder import SpindleEncoder
from lathe_machine.stages.tool.form import FormTable
from lathe_rc import messages
from lathe_rc.blocks.ports import Input, Output, Sparse
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.program import Program, Tapes, wired
from lathe_rc.cell.stage import NEVER, Stage
from lathe_rc.compiled.step import CompiledStep
from lathe_rc.errors import LatheError
from lathe_rc.jit import kernel
from lathe_rc.messages import COMMAND, ENCODER


@given(
    piece=st.integers(1, 20),
    pieces=st.integers(1, 12),
    last=st.integers(0, 19),
    delays=st.lists(st.integers(1, 70), min_size=1, max_size=3),
)
def test_what_is_read_late_is_what_was_written(piece, pieces, last, delays):
    longest = max(delays)
    tapes = Tapes({"encoder": (messages.ENCODER, {"angle": longest})}, piece)
    samples = piece * pieces + min(last, piece - 1)
    whole = np.concatenate([np.zeros(longest), np.arange(1.0, samples + 1)])  # from sample -longest on
    for first in range(0, samples, piece):
        size = min(piece, samples - first)
        tapes.advance(first)
        for array in tapes.view("encoder", first, size).values():
            array[:] = whole[longest + first :][:size]
        for delay in delays:
            seen = tapes.view("encoder", first, size, delay)["angle"]
            assert np.array_equal(seen, whole[longest + first - delay :][:size])


class Halving(Stage):
    """A stage in Python: the angle of the spindle, halved, as a command; it says each block that it takes."""

    kind = "halving"
    Parameters = NodeParameters
    actions = ("stop",)

    def __init__(self, name, table):
        super().__init__(name, table)
        self.blocks, self.on = [], True
        self.declare(inputs=[Input("encoder", ENCODER, ("angle",))], outputs=[Output("half", COMMAND)])

    def perform(self, action):
        self.on = False

    def process(self, first, inputs, outputs):
        self.blocks.append((first, inputs[0]["angle"].size))
        outputs[0]["position"][:] = inputs[0]["angle"] / 2 if self.on else 0.0
        return [Sparse("halving/events", messages.EVENT, first, {"action": "block"})]


class Refusing(Halving):
    """The same, but it cannot go on at sample 300."""

    def process(self, first, inputs, outputs):
        if first >= 300:
            raise LatheError("no more")
        return super().process(first, inputs, outputs)


def program(stage, chunk=100, samples=1000):
    spindle = SpindleEncoder("spindle", SpindleEncoder.Parameters.read("spindle", {"revolutions": 1.0}))
    tapes = Tapes({"encoder": (ENCODER, {}), "half": (COMMAND, {})}, samples)
    return Program([wired(spindle), wired(stage)], tapes, chunk), tapes


def made(kind, **values):
    return kind("halving", NodeParameters.read("halving", values))


def test_a_stage_in_python_is_asked_for_each_chunk_and_what_it_says_is_kept():
    stage = made(Halving)
    cell, tapes = program(stage)
    cell.run(450)
    cell.run(1000)
    firsts = [*range(0, 450, 100), *range(450, 1000, 100)]
    assert stage.blocks == [(first, 50 if first in (400, 950) else 100) for first in firsts]
    assert [message.index for message in cell.said(1, NEVER)] == firsts
    assert cell.said(1, NEVER) == []
    angle = tapes.view("encoder", 0, 1000)["angle"]
    assert angle[-1] > 0.0
    assert np.array_equal(tapes.view("half", 0, 1000)["position"], angle / 2)


def test_an_event_cuts_the_block_in_which_it_falls():
    stage = made(Halving, events=["sample 250: stop"])
    cell, tapes = program(stage)
    cell.run(1000)
    assert stage.blocks[2:5] == [(200, 50), (250, 50), (300, 100)]
    half = tapes.view("half", 0, 1000)["position"]
    assert half[249] > 0.0
    assert not half[250:].any()


def test_what_was_computed_before_an_error_is_there_and_the_stage_is_named():
    cell, tapes = program(made(Refusing))
    with pytest.raises(LatheError, match=r"^halving: no more"):
        cell.run(1000)
    assert cell.reached == 300
    assert tapes.view("half", 0, 300)["position"][-1] > 0.0


@kernel
def raising_step(memory, first, start, inputs, flags, outputs):
    if first >= 300:
        raise ValueError("a slip")
    return outputs[0].size, 0


class Raising(Halving):
    """A step with an error in it."""

    step = staticmethod(raising_step)

    @property
    def memory(self):
        return FormTable(np.zeros(1), np.zeros((1, 2, 4)), np.zeros((1, 2, 4)), True, 0, 0.0, 0.0, 0, np.zeros(1))  # noqa: FBT003


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_exception_in_a_step_is_not_lost():
    cell, _ = program(made(Raising))
    with pytest.raises(LatheError, match="halving: the step has raised an exception"):
        cell.run(1000)
    assert cell.reached == 300
    alone = made(Raising)
    with pytest.raises(LatheError, match="has raised an exception"):
        Stage.process(alone, 300, [{"angle": np.zeros(10)}], [{"position": np.zeros(10)}])


def test_a_stage_that_has_its_own_process_does_not_inherit_a_step():
    class Other(SpindleEncoder):
        def process(self, first, inputs, outputs):
            return []

    assert Other.step is None
    assert SpindleEncoder.step is not None


class Doubled(NamedTuple):
    factor: float


@kernel
def unpacking_step(memory, first, start, inputs, flags, outputs):
    (one, other), (flag,), (found, told) = inputs, flags, outputs
    for k in range(found.size):
        found[k], told[k] = one[k] - memory.factor * other[k], flag[k]
    return found.size, 0


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_step_of_others_unpacks_its_inputs_wherever_flags_stand_among_them(place):
    one, other, flag = np.arange(3.0), np.ones(3), np.array([7, 8, 9], np.uint8)
    inputs = [one, other]
    inputs.insert(place, flag)
    outputs = [np.zeros(3), np.zeros(3, np.uint8)]
    kinds = [[array.dtype for array in arrays] for arrays in (inputs, outputs)]
    assert CompiledStep(unpacking_step, Doubled(2.0), *kinds)(0, 0, [*inputs, *outputs], 3) == (3, 0)
    assert outputs[0].tolist() == [-2.0, -1.0, 0.0]
    assert outputs[1].tolist() == [7, 8, 9]
