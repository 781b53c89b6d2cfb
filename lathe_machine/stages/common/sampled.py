# SPDX-License-Identifier: Apache-2.0
"""Common part of user-defined laws and drives: a step that calls a user function for each sample."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.stage import Stage
from lathe_rc.compiled.step import Step, step_of
from lathe_rc.errors import InputError
from lathe_rc.extensions import code_of_others


class Sampled(Stage):
    """Stage whose step calls ``sample``, compiled if ``sample`` is a kernel.

    Raises:
        InputError: the class has no ``sample``.
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
        """Return the step in plain Python, which calls ``sample``."""

    @abstractmethod
    def start(self) -> Any:
        """Return the memory before sample 0."""

    def started(self) -> Any:
        """Return the memory of `start`, with plug-in errors as one line.

        Raises:
            InputError: `start` raises an exception.
        """
        with code_of_others(f"{self.name}: start"):
            return self.start()


def checked(what: str, told: object, at: Array) -> Complex:
    """Return the response provided by a third-party law or drive, checked, shape (n,).

    Args:
        what: description of the response.
        told: the response.
        at: waves or frequencies of the response, shape (n,).

    Raises:
        InputError: the response is not numeric, or its shape is wrong.
    """
    with code_of_others(what):
        found = np.asarray(told, np.complex128)
    if found.shape != at.shape:
        raise InputError(f"{what} gives the shape {found.shape} for {at.shape}; allowed: a number for each")
    return found
