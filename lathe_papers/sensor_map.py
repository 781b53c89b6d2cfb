# SPDX-License-Identifier: Apache-2.0
"""Effect of encoder and position-sensor errors on a law that does not know the speed, compared with the variable lead.

The cell of `lathe_papers.speed_deviation` runs with a frozen memory, with the variable lead of paper 000 (eq. 20) and
with ``disturbance_controller``, for combinations of encoder counts, resolution of the edges' times, noise, frequency of
the deviation, harmonic of the profile and seed. Some encoder counts give a small-integer ratio of counts per sample:
the pre-start check warns about them, unless the encoder gives the times of its edges.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Gt, Le
from rich.console import Group
from rich.table import Table as RichTable

from lathe_machine.stages.learning.learner import Learner
from lathe_papers import cells
from lathe_rc import messages
from lathe_rc.arrays import Array
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.parameters import Value, Values, parameter
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_BEGINS = 3.0  # [s] start of the deviation, after 50 revolutions at constant speed
_SHOWN = 1.0  # [s] duration of the deviation
_GOLDEN = 0.6180339887  # shift of the deviation's start from seed to seed, in revolutions
_PLAIN, _OURS = "speed_deviation", "robust"  # scenarios
_FREE: Values = {  # the study assumes the linear drive, without its limits
    "electrodynamic_actuator.max_velocity": 1e3,
    "electrodynamic_actuator.max_acceleration": 1e6,
    "electrodynamic_actuator.stroke": 1.0,
}


class SensorMapParameters(StudyParameters):
    """Parameters of the sensor-map study: sensors, deviations and profiles."""

    counts: list[Annotated[int, Ge(0), Le(2**31 - 1)]] = parameter(
        [1000, 2048, 3000, 3500, 3840, 4096, 4200, 5000, 7000, 8192, 10_000, 100_000, 1_000_000],
        "of the encoder per revolution; 0: ideal",
    )
    edge_clock_us: list[Annotated[float, Ge(0), Le(1000)]] = parameter(
        [0.0, 1.0], "resolutions of the times of the encoder's edges; 0: they have none", "µs"
    )
    noise_nm: list[Annotated[float, Ge(0), Le(10_000)]] = parameter([20.0], "RMS noise of the position sensor", "nm")
    wd: list[Annotated[float, Gt(0), Le(2000)]] = parameter(
        [20.0, 60.0, 106.0, 150.0, 213.0, 300.0], "frequencies of the deviation", "rad/s"
    )
    harmonics: list[Annotated[int, Ge(1), Le(40)]] = parameter([2, 4], "waves of the profile per revolution")
    seeds: list[Annotated[int, Ge(0), Le(2**31 - 1)]] = parameter(
        [0, 1, 2], "of the noise, and of where in a revolution the deviation begins"
    )
    amplitude_um: Annotated[float, Gt(0), Le(1000)] = parameter(225.0, "amplitude of the profile", "µm")
    deviation: Annotated[float, Gt(0), Le(50)] = parameter(10.5, "amplitude of the deviation", "rad/s")


@dataclass(frozen=True)
class SensorMapResult:
    """Results of the sensor-map study: largest errors during the speed deviation [µm].

    Arrays have the shape (counts, edge clocks, noise, harmonics, wd · seeds) unless noted.

    Attributes:
        parameters: parameters of the study.
        plain: errors of the variable lead.
        ours: errors of ``disturbance_controller``.
        floor: errors of the variable lead at constant speed, shape (counts, edge clocks, noise, harmonics).
        warned: whether the pre-start check warns about the encoder, shape (counts, edge clocks).
    """

    parameters: SensorMapParameters
    plain: Array
    ours: Array
    floor: Array
    warned: npt.NDArray[np.bool_]

    @property
    def ratio(self) -> Array:
        """Ratio of the error of ``disturbance_controller`` to that of the variable lead."""
        return self.ours / self.plain

    def to_json(self) -> dict[str, Any]:
        """Return all errors for JSON."""
        given = self.parameters
        return {
            **{
                name: getattr(given, name)
                for name in ("counts", "edge_clock_us", "noise_nm", "harmonics", "wd", "seeds")
            },
            "warned": self.warned.tolist(),
            "variable_lead_um": self.plain.tolist(),
            "disturbance_controller_um": self.ours.tolist(),
            "floor_um": self.floor.tolist(),
            "worst_ratio": float(self.ratio.max()),
            "worst_ratio_unwarned": float(self.ratio[~self.warned].max(initial=0.0)),
        }

    def table(self) -> Group:
        """Return tables of the worst ratio and the worst error over frequencies and seeds."""
        given = self.parameters
        tables: list[RichTable | str] = []
        columns = (
            "counts",
            "a sample",
            "edges",
            "warning",
            "nm",
            *(f"{harmonic} waves" for harmonic in given.harmonics),
        )
        shared = cells.load(_OURS).shared
        passed = shared.nominal_speed * shared.step / (2.0 * np.pi)  # revolutions per sample
        for title, values in (
            ("Largest error over that of the variable lead, at the worst wd and seed", self.ratio.max(axis=-1)),
            ("Largest error [µm], at the worst wd and seed", self.ours.max(axis=-1)),
        ):
            rows = [
                (
                    str(counts or "ideal"),
                    f"{counts * passed:.3g}",
                    f"{clock:g} µs" if clock else "no",
                    "yes" if self.warned[i, e] else "no",
                    f"{noise:g}",
                    *(f"{value:.2f}" for value in values[i, e, j]),
                )
                for (e, clock), (i, counts), (j, noise) in product(
                    enumerate(given.edge_clock_us), enumerate(given.counts), enumerate(given.noise_nm)
                )
            ]
            tables += [comparison(title, columns, rows), ""]
        told = []
        for e, clock in enumerate(given.edge_clock_us):
            ratio, warned = self.ratio[:, e], self.warned[:, e]
            edges = f"edges to {clock:g} µs" if clock else "no times of edges"
            told.append(f"{edges}: largest ratio of all {ratio.size}: {ratio.max():.2f}")
            if (others := ratio[~warned]).size and warned.any():
                told.append(f"of the {others.size} without a warning: {others.max():.2f}")
        return Group(*tables, *told)

    def draw(self, figure: "Figure") -> None:
        """Draw a map of counts against frequency for each edge clock and harmonic, at the middle noise level."""
        given = self.parameters
        noise = len(given.noise_nm) // 2
        shape = len(given.edge_clock_us), len(given.harmonics)
        panels = np.atleast_1d(figure.subplots(1, shape[0] * shape[1], sharey=True))
        for axes, (e, k) in zip(panels, np.ndindex(shape), strict=True):
            shown = self.ratio[:, e, noise, k].reshape(len(given.counts), len(given.wd), -1).max(axis=-1)
            image = axes.imshow(shown, vmin=0.0, vmax=1.0, cmap="viridis_r", aspect="auto")
            for (i, w), value in np.ndenumerate(shown):
                ink = "white" if value > 0.4 else "black"
                axes.text(w, i, f"{value:.2f}", ha="center", va="center", fontsize=7, color=ink)
            axes.set_xticks(range(len(given.wd)), [f"{wd:g}" for wd in given.wd], fontsize=7)
            axes.set_yticks(range(len(given.counts)), [str(counts or "ideal") for counts in given.counts], fontsize=7)
            clock = given.edge_clock_us[e]
            edges = f"edges to {clock:g} µs" if clock else "no times of edges"
            axes.set_title(f"{given.harmonics[k]} waves, {given.noise_nm[noise]:g} nm, {edges}", fontsize=9)
            axes.set_xlabel("deviation [rad/s]")
        panels[0].set_ylabel("counts per revolution")
        figure.colorbar(image, ax=list(panels), label="error over that of the variable lead")


class _Largest:
    """Recorder of the largest error [µm] from the start of the deviation."""

    def __init__(self, cell: Cell, samples: int) -> None:
        self._tool = next(topic for topic, source in cell.dense.items() if source.type == messages.TOOL)
        self.heard = [f"{self._tool}.error"]
        self._begins = round(_BEGINS / cell.master.shared.step)
        self._largest = 0.0

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Update the largest error with a chunk; samples before the start of the deviation are ignored."""
        error = dense[self._tool]["error"][max(self._begins - first, 0) :]
        self._largest = max(self._largest, float(np.abs(error).max(initial=0.0)) * 1e6)

    def kept(self) -> float:
        """Return the largest form error since the start of the deviation [µm]."""
        return self._largest


def _cells(parameters: SensorMapParameters) -> list[Scenario]:
    """Return the scenarios for all combinations of counts, edge clock, noise and harmonics.

    Each combination contains the plain law at constant speed, then both laws for each frequency and seed.
    """
    nominal = cells.load(_PLAIN).shared.nominal_speed
    turns = (_BEGINS + _SHOWN) * nominal / (2 * np.pi)
    bases = {
        (name, seed): cells.load(name, {"seed": seed}, spindle_encoder={"revolutions": turns})
        for name in (_PLAIN, _OURS)
        for seed in {0, *parameters.seeds}
    }
    made = []
    for counts, clock, noise, harmonic in product(
        parameters.counts, parameters.edge_clock_us, parameters.noise_nm, parameters.harmonics
    ):
        changes: dict[str, Value] = {
            **_FREE,
            "spindle_encoder.counts_per_revolution": counts,
            "spindle_encoder.edge_clock": clock * 1e-6,
            "electrodynamic_actuator.noise_rms": noise * 1e-9,
            "tool.harmonic_order": [harmonic],
            "tool.harmonic_amplitude": [parameters.amplitude_um * 1e-6],
        }
        for name, wd, seed in [(_PLAIN, 0.0, 0), *product((_PLAIN, _OURS), parameters.wd, parameters.seeds)]:
            swing: dict[str, Value] = {
                "spindle_encoder.deviation_amplitude": [parameters.deviation / nominal if wd else 0.0],
                "spindle_encoder.deviation_frequency": [wd or 1.0],
                "spindle_encoder.deviation_start": _BEGINS + seed * _GOLDEN % 1.0 * 2 * np.pi / nominal,
            }
            made.append(bases[name, seed].varied({**changes, **swing}))
    return made


def run(parameters: SensorMapParameters, track: Track = untracked) -> SensorMapResult:
    """Run all scenarios and collect the largest errors."""
    clocks = parameters.edge_clock_us
    shape = len(parameters.counts), len(clocks), len(parameters.noise_nm), len(parameters.harmonics), -1
    found = np.reshape(
        [np.nan if kept is None else kept for kept in cells.kept(_cells(parameters), _Largest, track)], shape
    )
    several = len(parameters.wd) * len(parameters.seeds)
    return SensorMapResult(
        parameters,
        found[..., 1 : several + 1],
        found[..., several + 1 :],
        np.ascontiguousarray(found[..., 0]),
        np.array([[_warned(parameters, counts, clock) for clock in clocks] for counts in parameters.counts]),
    )


def _warned(parameters: SensorMapParameters, counts: int, clock: float) -> bool:
    """Whether the pre-start check warns about an encoder with this number of counts and edge clock [µs]."""
    cell = Cell(cells.load(_OURS).nodes)
    nominal, law = cell.master.shared.nominal_speed, cell.stages["disturbance_controller"]
    assert isinstance(law, Learner), "it commands the drive"
    slowest, fastest = nominal - parameters.deviation, nominal + parameters.deviation
    return bool(law.encoder_warnings(slowest, fastest, counts, clock * 1e-6))


STUDY = Study(
    "sensor-map",
    "what encoder and sensor leave of a law that does not know the speed, against the variable lead",
    SensorMapParameters,
    run,
    size=(18.0, 4.2),
)
