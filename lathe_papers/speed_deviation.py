# SPDX-License-Identifier: Apache-2.0
"""Effect of an oscillating spindle speed on the error of each learning law (paper 000, Fig. 6).

The cell of ``config/speed_deviation.yaml`` learns a harmonic profile at constant speed; then the speed oscillates. The
protocol ``frozen`` freezes the memory at this point; with ``learning``, the law continues to learn.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group

from lathe_papers import cells, marks
from lathe_rc import messages
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Overrides = Mapping[str, object]

_CYCLES = 50  # learning cycles at constant speed
_SHOWN = 1.0  # [s] duration of the deviation, at least 1.5 periods
_DYNAMIC = "second_order_inverse_dynamic"
LAWS = (
    "time_periodic",
    "constant_lead",
    "variable_lead",
    "variable_lead_second_order",
    "second_order_inverse",
    "second_order_inverse_dynamic",
    "exact_preview",
    "exact_invariance",
    "adaptive_inverse",
    "disturbance_controller",
)
OURS = "disturbance_controller"  #: last of the laws, a separate stage in a separate cell
_TRACES = ("constant_lead", "variable_lead", "adaptive_inverse", OURS)


class SpeedDeviationParameters(StudyParameters):
    """Parameters of the speed-deviation study: profile, deviation and settings of the laws."""

    wd: list[Annotated[float, Gt(0), Le(2000)]] = parameter(
        [10.7, 106.0, 213.0], "frequencies of the deviation", "rad/s"
    )
    deviation: Annotated[float, Gt(0), Le(50)] = parameter(10.5, "amplitude of the deviation", "rad/s")
    harmonic: Annotated[int, Ge(1), Le(40)] = parameter(2, "waves of the profile per revolution")
    amplitude_um: Annotated[float, Gt(0), Le(1000)] = parameter(225.0, "amplitude of the profile", "µm")
    t0_ms: Annotated[float, Ge(0), Le(10)] = parameter(2.0, "lead time T0 of the laws without an inverse", "ms")
    q_us: Annotated[float, Ge(0), Le(1000)] = parameter(130.0, "time constant of Q", "µs")
    protocol: Literal["frozen", "learning"] = parameter(
        "frozen", "frozen: the memory is held while the speed swings; learning: it goes on"
    )
    cycle_revolutions: Annotated[int, Ge(1), Le(8)] = parameter(1, "cycle angle", "rev")
    adaptive_q_us: Annotated[float, Ge(0), Le(1000)] = parameter(40.0, "Q of adaptive_inverse", "µs")
    model_error: Annotated[float, Ge(0), Le(0.3)] = parameter(
        0.2, "of ωn and ζ that the laws that identify begin with, both ways: the worst of four is told"
    )
    encoder_counts: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(0, "per revolution; 0: an ideal encoder")
    sensor_noise_nm: Annotated[float, Ge(0), Le(1000)] = parameter(0.0, "RMS noise of the position sensor", "nm")


@dataclass(frozen=True)
class SpeedDeviationResult:
    """Results of the speed-deviation study: errors during the deviation.

    Attributes:
        parameters: parameters of the study.
        largest, rms: largest and RMS error by law, one value per frequency [µm].
        traces: curves of the figure by law, one pair (revolutions since the start of the deviation, error [µm]) for
            each frequency.
    """

    parameters: SpeedDeviationParameters
    largest: dict[str, list[float]]
    rms: dict[str, list[float]]
    traces: dict[str, list[tuple[Array, Array]]]

    def to_json(self) -> dict[str, Any]:
        """Return the errors by law for JSON."""
        return {"wd": self.parameters.wd, "max_um": self.largest, "rms_um": self.rms}

    def table(self) -> Group:
        """Return a table of largest and RMS errors, one row per law; the paper gives curves and this ordering."""
        given = self.parameters
        columns = ("law", *(f"{wd:g} rad/s" for wd in given.wd))
        title = f"{given.amplitude_um:g} µm, {given.harmonic} waves, ±{given.deviation:g} rad/s, {given.protocol}"
        tables = [
            comparison(f"{what} error [µm]: {title}", columns, [(law, *map(_figure, found[law])) for law in LAWS])
            for what, found in (("Largest", self.largest), ("RMS", self.rms))
        ]
        ratio = [c / v for c, v in zip(self.largest["constant_lead"], self.largest["variable_lead"], strict=True)]
        gains = {
            law: [v / a for v, a in zip(self.largest["variable_lead"], self.largest[law], strict=True)]
            for law in ("adaptive_inverse", OURS)
        }
        factors = comparison(
            "How many times smaller the largest error is",
            columns,
            [
                ("variable against constant lead", *(f"{r:.1f}" for r in ratio)),
                ("expected of Fig. 6 of paper 000", *("≥ 5, falling" for _ in ratio)),
                *(
                    (f"{law.replace('_', ' ')} against variable lead", *(f"{g:.1f}" for g in gain))
                    for law, gain in gains.items()
                ),
            ],
        )
        return Group(tables[0], "", tables[1], "", factors)

    def draw(self, figure: "Figure") -> None:
        """Draw Fig. 6 of the paper for up to three frequencies, and the largest error against the frequency."""
        given = self.parameters
        shown = list(enumerate(given.wd))[:3]
        *panels, overview = figure.subplots(1, len(shown) + 1)
        for axes, (place, wd) in zip(panels, shown, strict=True):
            for law in _TRACES:
                turns, error = self.traces[law][place]
                axes.plot(turns, error, lw=0.8, color=marks.COLOURS[LAWS.index(law)])
            axes.set(xlabel="revolutions since the deviation began", ylabel="form error [µm]")
            axes.set_title(f"deviation at {wd:g} rad/s", fontsize=10)
        order = np.argsort(given.wd)
        for number, law in enumerate(LAWS):
            overview.loglog(
                np.array(given.wd)[order], np.array(self.largest[law])[order], lw=1.0, ms=4, **marks.point(number),
                label=law.replace("_", " "),
            )  # fmt: skip
        overview.set(xlabel="frequency of the deviation [rad/s]", ylabel="largest form error [µm]")
        overview.set_title(f"all laws, {given.protocol}", fontsize=10)
        for axes in (*panels, overview):
            axes.grid(visible=True, alpha=0.3)
        figure.legend(*overview.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)


def _figure(value: float) -> str:
    return f"{value:.3g}"


def _models(parameters: SpeedDeviationParameters) -> list[Overrides]:
    """Return the initial drive models of the laws, with errors in natural frequency and damping."""
    ends = (1 - parameters.model_error, 1 + parameters.model_error)
    return [{"model_natural_frequency": 1038.0 * w, "model_damping": 0.804 * z} for w, z in product(ends, ends)]


def settings(parameters: SpeedDeviationParameters) -> dict[str, list[Overrides]]:
    """Return the learning controller's parameters by law, with several variants where the worst one counts."""
    lead, q = parameters.t0_ms * 1e-3, parameters.q_us * 1e-6
    delay = 0.36e-3  # delay of the drive, the only part that an inverse leaves to the lead
    inverse: Overrides = {"lead_time": delay, "q_time": q}
    adaptive: Overrides = {
        "correction": _DYNAMIC,
        "correction_model": "identified",
        "identify": True,
        "lead_law": "variable_second_order",
        "lead_time": delay,
        "q_time": parameters.adaptive_q_us * 1e-6,
        "soft_start": 1.0,
    }
    plain: Overrides = {"lead_time": lead, "q_time": q}
    return {
        "time_periodic": [{**plain, "law": "time_periodic"}],
        "constant_lead": [{**plain, "lead_law": "constant_angle"}],
        "variable_lead": [plain],
        "variable_lead_second_order": [{**plain, "lead_law": "variable_second_order"}],
        "second_order_inverse": [{**inverse, "correction": "second_order_inverse"}],
        "second_order_inverse_dynamic": [{**inverse, "correction": _DYNAMIC}],
        "exact_preview": [{**inverse, "correction": _DYNAMIC, "lead_law": "exact_preview"}],
        "exact_invariance": [{**plain, "correction": "exact", "lead_law": "exact_preview"}],
        "adaptive_inverse": [{**adaptive, **model} for model in _models(parameters)],
    }


def _run_cell(parameters: SpeedDeviationParameters, wd: float, name: str, controller: Overrides) -> tuple[Array, Array]:
    """Simulate the cell; return revolutions since the start of the deviation and the form error [µm]."""
    shared = cells.load("speed_deviation").shared
    nominal, rate = shared.nominal_speed, shared.sample_rate
    start = round(_CYCLES * parameters.cycle_revolutions * 2 * np.pi / nominal * rate) / rate
    shown = max(_SHOWN, 3 * np.pi / wd)
    frozen = parameters.protocol == "frozen"
    deviating = shown if frozen else 2 * shown  # while learning, one pass precedes the evaluation
    law = {
        "deviation_amplitude": [parameters.deviation / nominal],
        "deviation_frequency": [wd],
        "deviation_start": start,
    }
    amplitude = parameters.amplitude_um * 1e-6
    cell, node = ("robust", OURS) if name == OURS else ("speed_deviation", "learning_controller")
    if name != OURS:
        controller = {
            **controller,
            **(law if controller.get("lead_law") == "exact_preview" else {}),
            "cycle_revolutions": parameters.cycle_revolutions,
            "acceleration_window": 64 if parameters.encoder_counts else 1,
        }
    values: dict[str, Overrides] = {
        "spindle_encoder": {
            **law,
            "revolutions": (start + deviating) * nominal / (2 * np.pi),
            "counts_per_revolution": parameters.encoder_counts,
        },
        node: {**controller, "events": [f"second {start!r}: freeze"] if frozen else []},
        "electrodynamic_actuator": {
            "noise_rms": parameters.sensor_noise_nm * 1e-9,
            # The study assumes the linear drive, without its limits.
            "max_velocity": 1e3,
            "max_acceleration": 1e6,
            "stroke": 1.0,
        },
        "tool": {"harmonic_order": [parameters.harmonic], "harmonic_amplitude": [amplitude]},
    }
    result = cells.run(cell, **values)
    first = round((start + deviating - shown) * rate)
    angle = result.recording.of_type(messages.ENCODER)["angle_true"][first:]
    error = result.recording.of_type(messages.TOOL)["error"][first:]
    return (angle - angle[0]) / (2 * np.pi), error * 1e6


def run(parameters: SpeedDeviationParameters, track: Track = untracked) -> SpeedDeviationResult:
    """Simulate every law at every frequency of the deviation."""
    largest: dict[str, list[float]] = {law: [] for law in LAWS}
    rms: dict[str, list[float]] = {law: [] for law in LAWS}
    traces: dict[str, list[tuple[Array, Array]]] = {law: [] for law in _TRACES}
    of = {**settings(parameters), OURS: _models(parameters)}
    for wd, law in track(list(product(parameters.wd, LAWS))):
        runs = [_run_cell(parameters, wd, law, controller) for controller in of[law]]
        turns, error = max(runs, key=lambda run: float(np.abs(run[1]).max()))
        largest[law].append(float(np.abs(error).max()))
        rms[law].append(float(np.sqrt(np.mean(error**2))))
        if law in traces:
            every = max(error.size // 4000, 1)  # more points than the figure has pixels would only cost memory
            traces[law].append((turns[::every], error[::every]))
    return SpeedDeviationResult(parameters, largest, rms, traces)


STUDY = Study(
    "speed-deviation",
    "form error of each learning law while the spindle speed swings (000, Fig. 6)",
    SpeedDeviationParameters,
    run,
    size=(16.0, 4.0),
)
