# SPDX-License-Identifier: Apache-2.0
"""The common part of users' laws and drives: a step that calls a function of theirs for each sample."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from lathe_rc.analysis.learning import Array, Complex
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.stage import Stage
from lathe_rc.compiled.step import Step, step_of
from lathe_rc.errors import InputError
from lathe_rc.extensions import code_of_others


class Sampled(Stage):
    """A stage whose step calls ``sample``, compiled if that is a kernel.

    Raises:
        InputError: it has none.
    """

    sample: ClassVar[Callable[..., Any]]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "sample" in vars(cls):
            cls.step = staticmethod(step_of(cls, cls.loop(cls.sample), cls.sample))

    def __init__(self, name: str, parameters: NodeParameters) -> None:
        if self.step is None:
            raise InputError(f"{name}: {type(self).__name__} has no formula; allowed: sample = staticmethod(FUNCTION)")
        super().__init__(name, parameters)

    @staticmethod
    @abstractmethod
    def loop(sample: Callable[..., Any]) -> Step:
        """The step in plain Python, which calls ``sample``."""

    @abstractmethod
    def start(self) -> Any:
        """The memory before sample 0."""

    def started(self) -> Any:
        """Like `start`, with plug-in errors as one line.

        Raises:
            InputError: it raises something.
        """
        with code_of_others(f"{self.name}: start"):
            return self.start()


def checked(what: str, ask: Callable[[], Complex | None], at: Array) -> Complex:
    """A response that a law or drive of others tells, shape (n,).

    Args:
        what: it is, in words.
        ask: gives it.
        at: the waves or frequencies that it is asked for, shape (n,).

    Raises:
        InputError: it raises something, or gives another shape.
    """
    with code_of_others(what):
        told = np.asarray(ask(), np.complex128)
    if told.shape != at.shape:
        raise InputError(f"{what} gives the shape {told.shape} for {at.shape}; allowed: a number for each")
    return told
