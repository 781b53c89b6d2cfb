# SPDX-License-Identifier: Apache-2.0
"""The common part of all controllers that learn a drive, for the checks before a start."""

from abc import abstractmethod
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_rc.analysis.learning import Response
from lathe_rc.cell.parameters import ObedientParameters, RestartParameters, Value, parameter
from lathe_rc.cell.stages.drive import BoundedParameters
from lathe_rc.cell.stages.obedience import Obedience, Obedient
from lathe_rc.control import bounded
from lathe_rc.control.bounded import Takeover
from lathe_rc.errors import DivergedError


class LearnerParameters(ObedientParameters, BoundedParameters, RestartParameters):
    """Of a controller that learns a drive."""

    feedback_delay: Annotated[int, Ge(1), Le(2**24)] = parameter(
        2048,
        "samples from an error to when it is visible; at least a block, at most what the cycle leaves",
        "sample",
    )
    allow_unstable: bool = parameter(default=False, doc="start although the factor of a cycle is not below 1")
    stop_ratio: Annotated[float, Ge(0)] = parameter(
        0.0, "a cycle whose RMS error is more than so many times that of the first ends the run; 0: none does"
    )
    retract_position: float = parameter(0.0, "command when retracted", "m")
    retract_time: Annotated[float, Gt(0)] = parameter(
        1.0, "longest takeover: a command that is farther away begins where the way takes so long", "s"
    )


class Learner(Obedient):
    """A controller that learns a drive.

    Attributes:
        parameters: its table.
    """

    parameters: LearnerParameters
    factor: ClassVar[str] = "sup|factor of a cycle|"  #: what `worst` tells, in words
    remedy: ClassVar[str] = "change the law"  #: for a loop that diverges where none of its `cures` helps, in words

    @abstractmethod
    def worst(self, drive: Response, speed: float) -> tuple[float, float] | None:
        """Largest magnitude of the factor by which a cycle changes the error, and the waves per revolution where it is.

        Args:
            drive: response of the drive's position to its command.
            speed: of the spindle [rad/s].

        Returns:
            None: it does not tell.
        """

    def checked_speeds(self, low: float, high: float) -> Collection[float]:
        """Speeds [rad/s] for which `worst` is asked, of a spindle that turns between two."""
        return {low, (low + high) / 2, high}

    def cures(self, lag: float) -> Iterable[Iterable[Mapping[str, Value]]]:
        """Parameters that may make a loop converge which does not: of each kind of cure the gentlest first.

        Args:
            lag: of the drive at low frequencies [s].
        """
        return ()

    def settings(self) -> str:
        """The parameters that decide whether learning converges, in words."""
        return "its parameters"

    def encoder_warnings(self, low: float, high: float, counts: int) -> list[str]:
        """Causes of a form worse than the law can turn, with their cures, one line each; nothing is refused for them.

        Args:
            low: least speed of the spindle [rad/s].
            high: largest one [rad/s].
            counts: of its encoder per revolution; 0: an ideal one.
        """
        return []

    def largest_delay(self, speed: float, acceleration: float, count: float, speed_window: float) -> int | None:
        """Longest feedback delay [sample] that the cycle leaves.

        Args:
            speed: largest of the spindle [rad/s].
            acceleration: largest of the spindle [rad/s²].
            count: angle of one encoder count [rad]: the measured angle is late by up to that; 0 if ideal.
            speed_window: time over which the encoder measures its speed [s]: one count more in it is a larger lead.

        Returns:
            None: it does not tell.
        """
        return None

    def _make_obedience(self, settled: int) -> Obedience | None:
        """The obedience to the supervisor, if any; errors of ``settled`` samples after a takeover are not learned."""
        parameters = self.parameters
        if not parameters.reaction_delay:
            return None
        bounded.prepare()
        bounds = parameters.bounds()
        reach = bounds.reach(parameters.retract_time)
        takeover = Takeover(bounds, parameters.retract_position, parameters.step, reach=reach)
        return Obedience(self.name, takeover, settled=settled)

    def _diverged(self, index: int, rms: float, first: float) -> DivergedError:
        """Why a run is stopped: a cycle's RMS error and what it is compared with [m]."""
        ratio = rms / first if first > 0.0 else np.inf
        return DivergedError(
            f"sample {index}: the error grows: {rms * 1e6:.4g} µm RMS in a cycle, {ratio:.3g} times {first * 1e6:.4g} "
            f"µm; allowed: stop_ratio = {self.parameters.stop_ratio:g} (a smaller gain, or another law)"
        )
