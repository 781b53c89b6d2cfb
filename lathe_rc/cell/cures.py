# SPDX-License-Identifier: Apache-2.0
"""Parameters of a learning controller with which its loop converges: what is named as a cure has been tried."""

from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from lathe_rc.analysis.learning import Response
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.stages.learner import Learner
from lathe_rc.errors import InputError

_SAFE = 0.98  # factor of a cycle that a cure leaves at most
_BANDS = np.geomspace(60_000.0, 500.0, 32)  # [rad/s] where a flat Q may end
# Where its stop band begins, over that, and its ripple: the flattest first. One with a longer kernel may not fit into
# the memory, which holds fewer points a second the slower the spindle turns.
_SHAPES = ((2.0, 1e-6), (3.0, 1e-6), (2.0, 1e-4), (3.0, 1e-4), (2.0, 1e-3), (2.0, 1e-2))


def lag(response: Response) -> float:
    """Lag of a drive at low frequencies [s]."""
    low = 1.0
    return float(-np.angle(response(np.array([low])))[0] / low)


class Loop(NamedTuple):
    """A learning controller with the drives that it commands.

    Attributes:
        stage: the controller.
        responses: of the drives.
        speeds: at which the loop is looked at [rad/s].
    """

    stage: Learner
    responses: Collection[Response]
    speeds: Collection[float]

    def factor(self, values: Mapping[str, Value]) -> float:
        """Largest factor of a cycle with some parameters changed; inf: there is no such controller, or it is silent."""
        try:
            stage = type(self.stage)(self.stage.name, self.stage.parameters.model_copy(update=dict(values)))
        except InputError:  # the memory has no room for it
            return np.inf
        told = [stage.worst(response, speed) for response in self.responses for speed in self.speeds]
        return max((np.inf if worst is None or np.isnan(worst[0]) else worst[0] for worst in told), default=np.inf)

    def first(self, candidates: Iterable[Mapping[str, Value]], allowed: float = _SAFE) -> Mapping[str, Value] | None:
        """The first parameters with which no factor is above what is allowed; None: there are none."""
        return next((values for values in candidates if self.factor(values) <= allowed), None)

    def cures(self) -> list[str]:
        """Parameters to set so that a loop converges that does not."""
        found: list[Mapping[str, Value]] = []
        for candidates in self.stage.cures(max(map(lag, self.responses))):
            cure = self.first(each for each in candidates if not any(each.keys() >= known.keys() for known in found))
            found += [cure] if cure else []
        name = self.stage.name
        return [" and ".join(f"{name}.{key} = {value:g}" for key, value in cure.items()) for cure in found]

    def flat(
        self,
        allowed: float,
        stop: float | None = None,
        ripple: float | None = None,
        others: Mapping[str, Value] = MappingProxyType({}),
    ) -> dict[str, Value] | None:
        """The widest flat Q, an FIR low-pass, of the first shape with which the loop converges; None: there is none.

        Args:
            allowed: factor of a cycle.
            stop: begin of its stop band [rad/s]; None: free.
            ripple: None: free.
            others: parameters that are changed as well.
        """
        for ratio, each in dict.fromkeys((ratio, ripple or own) for ratio, own in _SHAPES):
            bands = _BANDS if stop is None else _BANDS[stop > _BANDS]
            made = ({"q_pass": float(band), "q_stop": stop or float(ratio * band)} for band in bands)
            shape = {**others, "q_filter": "fir", "q_ripple": each}
            if found := self.first(({**shape, **band} for band in made), allowed):
                return dict(found)
        return None
