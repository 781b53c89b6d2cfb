# SPDX-License-Identifier: Apache-2.0
"""Stages that are set back: all that a run changes of them, and what nobody can set back is not tried."""

import random
from functools import cached_property

import numpy as np
import pytest

from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.stage import Output, Stage
from lathe_rc.cell.stage_cache import Start, UnknownPartError
from lathe_rc.messages import COMMAND


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
