# SPDX-License-Identifier: Apache-2.0
"""Stability margin of the learning controller: how far the loop of its memory is from diverging."""

from bisect import bisect_left
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from lathe_rc.analysis.learning import LearningLoop, Response
from lathe_rc.cell.stages.learning_parameters import LearningControllerParameters
from lathe_rc.control.correction import Correction
from lathe_rc.control.identification import Identified
from lathe_rc.plants.linear import discretise, second_order

_MOST = 1024  # entries of a table


class Loops(Protocol):
    """The stage, as far as it is needed here."""

    @property
    def correction(self) -> Correction:
        """1/W0 as it is at the moment."""

    def loop(self, drive: Response) -> LearningLoop:
        """The learning loop around a drive with the given response."""


class Margins:
    """1 - sup|Q - γZ| of a drive model, tabulated as it is asked for: one costs as much as a cycle of samples.

    Args:
        parameters: of the stage.
    """

    def __init__(self, parameters: LearningControllerParameters) -> None:
        self._parameters = parameters
        self._models: dict[tuple[str, ...], Identified] = {}
        self._responses: dict[tuple[str, ...], Response] = {}
        self._suprema: dict[tuple[object, ...], float] = {}

    def __getstate__(self) -> dict[str, Any]:
        """The state without responses, which are computed when they are asked for."""
        return {**self.__dict__, "_responses": {}}

    def _response(self, model: Identified) -> Response:
        # Three digits of a model are more than its margin is good for, and a steady one is computed once.
        key = _three_digits(model.natural_frequency, model.damping)
        if key not in self._models:
            _make_room(self._models)
            self._models[key] = model
        model = self._models[key]
        if key not in self._responses:
            _make_room(self._responses)
            self._responses[key] = self._computed(model)
        return self._responses[key]

    def _computed(self, model: Identified) -> Response:
        parameters = self._parameters
        a, b = second_order(model.natural_frequency, model.damping)
        return discretise(a, b, parameters.model_delay, parameters.step, "foh").response

    def untabulated(self, stage: Loops, speed: float, model: Identified) -> float:
        """The margin at ``speed`` [rad/s] of this very model; what was tabulated before and after does not matter."""
        return 1.0 - stage.loop(self._computed(model)).supremum(speed)

    def _supremum(self, stage: Loops, speed: float, model: Identified) -> float:
        inverted = stage.correction
        models = (model.natural_frequency, model.damping, inverted.natural_frequency, inverted.damping)
        key = (speed, _three_digits(*models))
        if key not in self._suprema:
            _make_room(self._suprema)
            self._suprema[key] = stage.loop(self._response(model)).supremum(speed)
        return self._suprema[key]

    def at(self, stage: Loops, speed: float, model: Identified) -> float:
        """The margin at ``speed`` [rad/s], between tabulated speeds by interpolation."""
        speeds = _tabulated(self._parameters.nominal_speed)
        after = bisect_left(speeds, speed)
        if not 0 < after < len(speeds):
            return 1.0 - stage.loop(self._response(model)).supremum(speed)
        below, above = speeds[after - 1], speeds[after]
        lower, upper = self._supremum(stage, below, model), self._supremum(stage, above, model)
        return 1.0 - ((upper - lower) / (above - below) * (speed - below) + lower)


@lru_cache(maxsize=16)
def _tabulated(nominal: float) -> list[float]:
    """The speeds of the table [rad/s], from half of the nominal one up to one and a half times it."""
    speeds: list[float] = (nominal / 40 * np.arange(20, 61)).tolist()
    return speeds


def _make_room(table: dict[Any, Any]) -> None:
    """Let the oldest entry go from a full table: a model that wanders would fill it for ever."""
    if len(table) >= _MOST:
        del table[next(iter(table))]


@lru_cache
def _three_digits(*numbers: float) -> tuple[str, ...]:
    return tuple(f"{number:.3g}" for number in numbers)
