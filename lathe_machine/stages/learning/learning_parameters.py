# SPDX-License-Identifier: Apache-2.0
"""Parameters of the learning controller, and construction of the elements of its law."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Annotated, ClassVar, Literal, cast

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from lathe_machine.control.correction import Correction, CorrectionLaw
from lathe_machine.control.lead import LeadLaw, Preview
from lathe_machine.control.q_filter import Exponential, Gaussian, LowPass, MovingAverage, QFilter, check
from lathe_machine.stages.learning.learner import LawParameters
from lathe_machine.stages.spindle.speed_law import SpeedLawParameters
from lathe_rc.cell import models
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, Values, about, parameter
from lathe_rc.cell.time_master import TimeMasterParameters
from lathe_rc.errors import InputError
from lathe_rc.extensions import Named, Registry, code_of_others
from lathe_rc.messages import Samples

_LEAD_LAWS = {law.name.lower(): law for law in LeadLaw}
#: built-in and third-party filters, by name; each is made from its width in grid points and the grid points of a cycle
Q_FILTERS: Registry[QFilter] = Registry(
    "Q filter",
    QFilter,
    {"exponential": Exponential, "gaussian": Gaussian, "moving_average": MovingAverage},
    "lathe_rc.q_filters",
)
_CORRECTIONS = {law.name.lower(): law for law in CorrectionLaw}


@lru_cache(maxsize=64)
def _own_q(make: Callable[..., QFilter], *numbers: float) -> QFilter:
    """Return a built-in Q filter, shared for equal arguments since it has no state; its loops are shared as well."""
    return make(*numbers)


class LearningControllerParameters(SpeedLawParameters, LawParameters):
    """Law, lead, Q and correction of a channel, and the drive model for its stability margin.

    The speed deviations are used only by ``exact_preview``, which needs them in advance.
    """

    stop_ratio: NonNegative = parameter(
        0.0, "a cycle whose RMS error is more than so many times that of the first ends the run; 0: none does"
    )
    law: Literal["angle_domain", "time_periodic"] = parameter(
        "angle_domain", "memory over the spindle angle (paper 000, Fig. 1b) or over time (Fig. 1a)"
    )
    lead_time: Annotated[float, Ge(0), Le(1)] = parameter(
        1.425e-3, "T0: the delay that the lead answers; with a second-order inverse only the drive's pure delay", "s"
    )
    lead_law: Literal["variable", "constant_angle", "variable_second_order", "exact_preview"] = parameter(
        "variable",
        "variable: T0·Ω (000, eq. 20); constant_angle: T0·Ω0; variable_second_order: T0·Ω + T0²/2·dΩ/dt; "
        "exact_preview: φ(t+T0) - φ(t) of the deviations below",
    )
    acceleration_window: Annotated[int, Ge(1), Le(65536)] = parameter(
        1, "dΩ/dt is the measured speed's difference over so many samples", "sample"
    )
    correction: Literal["none", "lead_lag", "second_order_inverse", "second_order_inverse_dynamic", "exact", "fir"] = (
        parameter(
            "none",
            "1/W0 beside the lead; exact: Wk2 then Wk1 (000, eqs 13-14), for which T0 counts in full; fir: "
            "correction_taps, the first of which has the lead T0",
        )
    )
    correction_model: Literal["given", "identified"] = parameter(
        "given", "drive model of the correction: the one below, or the one identified as long as the channel learns"
    )
    lead_lag_lead: Annotated[float, Ge(0), Le(1)] = parameter(0.0, "correction lead_lag: T1", "s")
    lead_lag_lag: Annotated[float, Ge(0), Le(1)] = parameter(0.0, "correction lead_lag: T2", "s")
    correction_taps: list[float] = parameter(
        [],
        "correction fir: the command is their sum with the memory, each read correction_interval later than the last",
    )
    correction_interval: Annotated[float, Ge(0), Le(0.1)] = parameter(0.0, "correction fir: time between its taps", "s")
    q_filter: Annotated[str, Named(Q_FILTERS, ("fir",))] = parameter(
        "exponential", "kind of the zero-phase Q; fir: flat up to q_pass"
    )
    q_time: Annotated[float, Ge(0), Le(1)] = parameter(
        67.0e-6, "width of Q at nominal speed: Q = 1 - (ω·q_time)² for low ω; fixed in angle; not of fir", "s"
    )
    q_pass: Positive = parameter(4000.0, "fir: end of the pass band at nominal speed", "rad/s")
    q_stop: Positive = parameter(10000.0, "fir: begin of the stop band at nominal speed", "rad/s")
    q_ripple: Annotated[float, Gt(1e-8), Lt(0.5)] = parameter(1e-4, "fir: ripple in both bands")
    learning_gain: Annotated[float, Gt(0), Le(2)] = parameter(1.0, "γ; 1 in the papers")
    soft_start: Annotated[float, Ge(0), Le(1024)] = parameter(
        0.0, "the gain rises from 0 over so many revolutions when learning begins; 0: at once", "rev"
    )
    join_below: NonNegative = parameter(
        0.0,
        "the channel learns from the first cycle on, and the first after a reaction, within this error; 0: at once",
        "m",
    )
    cycle_weights: list[NonNegative] = parameter(
        [1.0], "weights of the newest cycles in what the drive is sent, the newest first; only their ratios matter"
    )
    finer: list[str] = parameter(
        [], "drives after this channel: their motion is added to the tool's error, so that it learns its own error"
    )
    points_per_revolution: Annotated[int, Ge(64), Le(65536)] = parameter(1024, "points of the memory per revolution")
    cycle_revolutions: Annotated[int, Ge(1), Le(1024)] = parameter(
        1, "cycle angle θ; the whole part if it is as long", "rev"
    )
    fall_back: Literal["frozen", "constant_lead"] = parameter(
        "frozen", "falling back: the memory frozen, or moreover read with the lead angle of the nominal speed"
    )
    memory_file: str = parameter("", "file that the events save and load write and read", path=True)
    publish_margin: bool = parameter(
        default=False, doc="publish the stability margin sample by sample as well, on coarse/margin, for a supervisor"
    )
    identify: bool = parameter(default=True, doc="identify the drive from its command and measured position")
    identification_bandwidth: Positive = parameter(
        1000.0, "bandwidth of its filters: above the profile's harmonics, below the noise", "rad/s"
    )
    identification_forgetting: Annotated[float, Ge(0), Lt(1)] = parameter(
        0.5, "weight that a cycle's measurements keep after the next"
    )
    model_natural_frequency: Positive = parameter(1038.0, "drive model: ωn", "rad/s", drive="natural_frequency")
    model_damping: Positive = parameter(0.804, "drive model: ζ", drive="damping")
    model_delay: Annotated[float, Ge(0), Le(0.1)] = parameter(0.36e-3, "drive model: delay", "s", drive="delay")

    commanded_topic: ClassVar[str] = "coarse/command"

    def causes_off(self, node: str, nodes: Mapping[str, NodeParameters], height: Samples) -> dict[str, Values]:
        """Return the causes ``model`` (of a correction, it differs from the drive), ``speed`` and ``lead``.

        The lead follows the speed; off: an exact preview of the speed (implements `NodeParameters.causes_off`).
        """
        found: dict[str, Values] = {}
        if self.correction not in ("none", "lead_lag", "fir"):
            found["model"] = models.of_drives(node, nodes)
        for law in nodes.values():
            if isinstance(law, TimeMasterParameters) and isinstance(law, SpeedLawParameters) and law.varies:
                found["speed"] = steady = self.steady()
                followed = {name: getattr(law, name) for name in steady}
                found["lead"] = followed | {"law": "angle_domain", "lead_law": "exact_preview"}
        return found

    @property
    def cycle_points(self) -> int:
        """Number of grid points in a cycle."""
        return self.points_per_revolution * self.cycle_revolutions

    def make_q(self, node: str) -> QFilter:
        """Return the Q filter of a node.

        Raises:
            InputError: the filter exceeds the memory, its bands are out of order, or a third-party filter is invalid.
        """
        if self.q_filter not in (*Q_FILTERS.own, "fir"):
            make = cast("Callable[[float, int], QFilter]", Q_FILTERS[self.q_filter])
            with about(node, "q_filter"), code_of_others(repr(self.q_filter)):
                made = make(self._q_width, self.cycle_points)
                check(made)
                return made
        with about(node, *(("q_pass", "q_stop", "q_ripple") if self.q_filter == "fir" else ("q_time",))):
            try:
                return self._own_q()
            except InputError as error:
                raise InputError(f"{error}{self._q_that_fits()}") from None

    @property
    def _point_time(self) -> float:
        """Time from one grid point to the next at nominal speed [s]."""
        return float(1.0 / (self.nominal_speed * (self.points_per_revolution / (2 * np.pi))))

    @property
    def _q_width(self) -> float:
        """Width ``q_time`` at nominal speed [grid points]; the order of the operations determines the last bits."""
        return float(self.q_time * self.nominal_speed * (self.points_per_revolution / (2 * np.pi)))

    def _own_q(self) -> QFilter:
        """Return the built-in Q filter."""
        point = self._point_time
        if self.q_filter == "fir":
            return _own_q(LowPass, self.q_pass * point, self.q_stop * point, self.q_ripple, self.cycle_points)
        make = cast("Callable[[float, int], QFilter]", Q_FILTERS[self.q_filter])
        return _own_q(make, self._q_width, self.cycle_points)

    def _q_that_fits(self) -> str:
        """Describe nearby parameters of a Q filter that fits into the memory, for an error message."""
        highest = float(f"{0.99 * np.pi / self._point_time:.3g}")  # highest frequency on the grid [rad/s]
        tried: list[dict[str, float]] = []
        for k in range(1, 60):
            if self.q_filter != "fir":
                tried.append({"q_time": self.q_time * 0.8**k})
            elif self.q_pass < highest:  # a wider transition has a shorter kernel
                stop = self.q_stop if self.q_pass < self.q_stop < highest else self.q_pass
                tried.append({"q_stop": min(stop * 1.1**k, highest)})
            else:
                tried.append({"q_pass": highest * 0.8**k, "q_stop": highest})
        for values in tried:
            rounded = {name: float(f"{value:.3g}") for name, value in values.items()}
            try:
                self.model_copy(update=rounded)._own_q()  # noqa: SLF001 - its own class
            except InputError:
                continue
            return f"; as with {' and '.join(f'{name} = {value:g}' for name, value in rounded.items())}"
        return "; as with more points_per_revolution"

    def weights(self, node: str) -> list[float]:
        """Return the weights of the newest cycles.

        Raises:
            InputError: none of them is above 0.
        """
        if not self.cycle_weights or not self.cycle_weights[0] > 0.0:
            raise InputError(f"{node}.cycle_weights = {self.cycle_weights}; allowed: one or more, the first above 0")
        return self.cycle_weights

    def make_correction(self, node: str) -> Correction:
        """Return the correction of a node with its given model.

        Raises:
            InputError: a lead-lag term has no lag, or an FIR filter no taps or no lead, or it reaches too far back.
        """
        if self.correction == "fir":
            longest = self.lead_time + np.pi * self.cycle_revolutions / self.nominal_speed
            if not self.lead_time > 0.0:
                raise InputError(f"{node}.lead_time = 0 s with correction fir; allowed: above 0")
            taps, interval = len(self.correction_taps), self.correction_interval
            if (span := taps * interval) > longest:
                raise InputError(
                    f"{node}: {taps} correction_taps in steps of {interval:g} s reach over {span:.4g} s; "
                    f"allowed: up to {longest:.4g} s, the lead_time and half a cycle"
                )
        named = ("correction_taps", "correction_interval") if self.correction == "fir" else ("lead_lag_lag",)
        with about(node, *named):
            return Correction(
                _CORRECTIONS[self.correction],
                self.model_natural_frequency,
                self.model_damping,
                self.lead_lag_lead,
                self.lead_lag_lag,
                tuple(self.correction_taps),
                self.correction_interval,
            )

    @property
    def preview_time(self) -> float:
        """Time compensated by the lead law [s]: T0, or only the delay of the model with the exact correction."""
        return self.model_delay if self.correction == "exact" else self.lead_time

    @property
    def constant_lead(self) -> float:
        """Speed-independent lead angle [rad]: that of Wk2, whose parameters are constant in the angle domain."""
        return (self.lead_time - self.preview_time) * self.nominal_speed

    def make_preview(self, node: str) -> Preview:
        """Return the lead law of a node.

        Raises:
            InputError: the speed deviations are inconsistent.
        """
        return Preview(
            _LEAD_LAWS[self.lead_law],
            self.preview_time,
            self.speed_law(node),
            self.step,
            self.acceleration_window,
            self.constant_lead,
        )

    def largest_lead(self, speed: float, acceleration: float) -> float:
        """Return the largest lead angle [rad] up to a measured ``speed`` [rad/s] and an ``acceleration`` [rad/s²]."""
        time = self.preview_time
        if self.lead_law == "constant_angle":
            return time * self.nominal_speed + self.constant_lead
        bend = 0.5 * time**2 * acceleration if self.lead_law == "variable_second_order" else 0.0
        return time * speed + bend + self.constant_lead
