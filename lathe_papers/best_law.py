# SPDX-License-Identifier: Apache-2.0
"""Comparison of learning laws: which law errs least, depending on speed deviation, model error and sensors.

Every law of the ``speed-deviation`` study turns the oval of ``config/speed_deviation.yaml`` under the same conditions:
a Sobol sample of the frequency and amplitude of the deviation, the assumed ωn and ζ of the drive, and the noise of the
position sensor, each for several encoders. The law keeps learning while the speed oscillates. The criterion is the
largest form error of the last revolutions, over a period of the slowest deviation. Laws with advance knowledge of the
speed are shown, but not ranked. The study is a sweep; see docs/sweeps.md.
"""

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
from annotated_types import Ge, Gt, Le
from rich.console import Group

from lathe_papers import cells, marks, sweeps
from lathe_papers.speed_deviation import LAWS, SpeedDeviationParameters, settings
from lathe_rc.arrays import Array
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.scenario import Scenario
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_LEARNED, _REVOLUTIONS, _JUDGED = 20.0, 50.0, 11  # revolutions at constant speed, in total, and evaluated at the end
_TOLD = ("exact_preview", "exact_invariance")  # laws with advance knowledge of the speed
_PLAIN, _ADAPTIVE = "variable_lead", "adaptive_inverse"
_FREQUENCY = "spindle_encoder.deviation_frequency[0]"
_AMPLITUDE = "spindle_encoder.deviation_amplitude[0]"
_COUNTS = "spindle_encoder.counts_per_revolution"
_NOISE = "electrodynamic_actuator.noise_rms"
_MODEL = "learning_controller.model_natural_frequency"
_DAMPING = "learning_controller.model_damping"


class BestLawParameters(StudyParameters):
    """Parameters of the law comparison: ranges of the sampled conditions."""

    points: Annotated[int, Ge(4), Le(2**16)] = parameter(128, "conditions for each encoder and law")
    encoder_counts: list[Annotated[int, Ge(1000), Le(2**31 - 1)]] = parameter(
        [1000, 3840, 10_000, 100_000, 1_000_000], "per revolution; 3840 are one a sample at the nominal speed"
    )
    seeds: Annotated[int, Ge(1), Le(100)] = parameter(3, "of noise and encoder, at each condition")
    lowest_wd: Annotated[float, Ge(10), Le(1000)] = parameter(10.0, "of the frequency of the deviation", "rad/s")
    highest_wd: Annotated[float, Ge(10), Le(1000)] = parameter(300.0, "of the same", "rad/s")
    largest_deviation: Annotated[float, Gt(0.005), Le(0.3)] = parameter(0.1, "of the nominal speed; from 0.005 on")
    model_error: Annotated[float, Ge(0), Le(0.3)] = parameter(0.2, "of ωn and ζ that the laws know, at most")
    most_noise_nm: Annotated[float, Gt(0.1), Le(1000)] = parameter(200.0, "RMS of the position sensor; from 0.1", "nm")
    folder: str = parameter("", "keeps the rows, and goes on from them; empty: nothing is kept")


@dataclass(frozen=True)
class BestLawResult:
    """Results of the law comparison: error of each law under each condition.

    Attributes:
        parameters: parameters of the study.
        counts, frequency, amplitude, noise, model: values of each condition, repeated for each of its seeds in
            consecutive entries, shape (conditions * seeds,) [1, rad/s, 1, nm, 1].
        error: largest error of the last revolutions by law; infinite if the law is rejected or diverges [µm].
    """

    parameters: BestLawParameters
    counts: Array
    frequency: Array
    amplitude: Array
    noise: Array
    model: Array
    error: dict[str, Array]

    @property
    def rivals(self) -> list[str]:
        """Ranked laws: all laws without advance knowledge of the speed."""
        return [law for law in self.error if law not in _TOLD]

    @property
    def best(self) -> list[str]:
        """Best ranked law (smallest error) under each condition."""
        errors = np.array([self.error[law] for law in self.rivals])
        return [self.rivals[place] for place in np.argmin(errors, axis=0)]

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON: how often each law is best, agreement between seeds, and medians."""
        return {
            "conditions": self.counts.size // self.parameters.seeds,
            "seeds": self.parameters.seeds,
            "best": {str(counts): self._shares(counts) for counts in self.parameters.encoder_counts},
            "seeds_agree": {str(counts): self._agreed(counts) for counts in self.parameters.encoder_counts},
            "median_um": {str(counts): self._medians(counts) for counts in self.parameters.encoder_counts},
        }

    def _shares(self, counts: int) -> dict[str, float]:
        """Return the share of one encoder's conditions in which each ranked law is best [%]."""
        best = [law for law, of in zip(self.best, self.counts, strict=True) if of == counts]
        found = Counter(best)
        return {law: 100.0 * found[law] / len(best) for law in self.rivals}

    def _agreed(self, counts: int) -> float:
        """Return the share of one encoder's conditions in which all seeds have the same best law [%]."""
        best = np.array(self.best)[self.counts == counts].reshape(-1, self.parameters.seeds)
        return 100.0 * float(np.mean((best == best[:, :1]).all(axis=1)))

    def _medians(self, counts: int) -> dict[str, float]:
        return {law: float(np.median(error[self.counts == counts])) for law, error in self.error.items()}

    def table(self) -> Group:
        """Return tables of the best laws, their errors, and the adaptive inverse against the variable lead."""
        encoders = self.parameters.encoder_counts
        columns = ("law", *(f"{counts:,}" for counts in encoders))
        shares, medians = ({c: of(c) for c in encoders} for of in (self._shares, self._medians))
        ratio = self.error[_PLAIN] / self.error[_ADAPTIVE]
        tables = [
            comparison(
                "Conditions in which a law errs least [%], by counts of the encoder",
                columns,
                [
                    *((law, *(f"{shares[c][law]:.0f}" for c in encoders)) for law in self.rivals),
                    (f"the same with all {self.parameters.seeds} seeds", *(f"{self._agreed(c):.0f}" for c in encoders)),
                ],
            ),
            comparison(
                "Median of the largest error [µm]",
                columns,
                [(law, *(f"{medians[c][law]:.3g}" for c in encoders)) for law in self.error],
            ),
            comparison(
                "Variable lead over adaptive inverse: how many times smaller the error gets",
                columns,
                [
                    (what, *(f"{float(np.quantile(ratio[self.counts == c], share)):.2g}" for c in encoders))
                    for what, share in (("worst tenth below", 0.1), ("median", 0.5), ("best tenth above", 0.9))
                ],
            ),
        ]
        return Group(tables[0], "", tables[1], "", tables[2])

    def draw(self, figure: "Figure") -> None:
        """Draw maps of the best law over the deviation, and of two laws compared over noise and model error."""
        encoders = self.parameters.encoder_counts
        upper, lower = figure.subplots(2, len(encoders), squeeze=False)
        best, ratio = np.array(self.best), np.log10(self.error[_PLAIN] / self.error[_ADAPTIVE])
        for place, counts in enumerate(encoders):
            of = self.counts == counts
            for law in self.rivals:
                here = of & (best == law)
                if here.any():
                    mark = marks.point(LAWS.index(law))
                    upper[place].scatter(
                        self.frequency[here], self.amplitude[here] * 100.0, s=12, label=law.replace("_", " "), **mark
                    )
            upper[place].set(xscale="log", xlabel="frequency of the deviation [rad/s]", ylabel="deviation [%]")
            upper[place].set_title(f"the best law, {counts:,} counts", fontsize=10)
            upper[place].set_ylim(0.0, 135.0 * self.parameters.largest_deviation)  # room for the legend
            upper[place].legend(fontsize=6, loc="upper left")
            for better, marker in ((True, "^"), (False, "v")):
                here = of & ((ratio > 0.0) == better)
                shown = lower[place].scatter(
                    self.noise[here], 100.0 * (self.model[here] - 1.0), c=np.clip(ratio[here], -1.5, 1.5), s=14,
                    marker=marker, cmap="RdBu", vmin=-1.5, vmax=1.5, edgecolors="0.4", linewidths=0.3,
                )  # fmt: skip
            lower[place].set(xscale="log", xlabel="noise [nm]", ylabel="error of the model's ωn [%]")
            lower[place].set_title("adaptive inverse against variable lead", fontsize=10)
        bar = figure.colorbar(shown, ax=lower.tolist(), ticks=[-1, 0, 1], shrink=0.9)
        bar.ax.set_yticklabels(["▼ 10 times worse", "equal", "▲ 10 times better"], fontsize=7)


def _base() -> Scenario:
    start = _LEARNED * 60.0 / 1000.0
    law = {"deviation_amplitude": [0.05], "deviation_frequency": [20.0], "deviation_start": start}
    return cells.load(
        "speed_deviation",
        spindle_encoder={**law, "revolutions": _REVOLUTIONS},
        learning_controller={**law, "events": [], "acceleration_window": 64},
        # The study assumes the linear drive, without its limits.
        electrodynamic_actuator={"max_velocity": 1e3, "max_acceleration": 1e6, "stroke": 1.0},
        tool={"harmonic_order": [2], "harmonic_amplitude": [225e-6]},
    )


def run(parameters: BestLawParameters, track: Track = untracked) -> BestLawResult:
    """Run the sweep and collect the error of each law under each condition."""
    from lathe_explore.sweep.space import Space

    base = _base()
    laws = {law: values[0] for law, values in settings(SpeedDeviationParameters(model_error=0.0)).items()}
    own = {f"learning_controller.{name}" for values in laws.values() for name in values} - {_MODEL, _DAMPING}
    known = {target: base.value(target) for target in sorted(own)}
    given: list[dict[str, Any]] = [
        known | {f"learning_controller.{name}": v for name, v in values.items() if f"learning_controller.{name}" in own}
        for values in laws.values()
    ]
    low, high = (f"{100.0 * (1.0 + sign * parameters.model_error)}%" for sign in (-1, 1))
    space = Space(
        given=given,
        grid={_COUNTS: parameters.encoder_counts},
        sampled={
            _FREQUENCY: f"{parameters.lowest_wd}:{parameters.highest_wd}:log",
            _AMPLITUDE: f"0.005:{parameters.largest_deviation}",
            _NOISE: f"0.1e-9:{parameters.most_noise_nm * 1e-9}:log",
            _MODEL: f"{low}:{high}",
            _DAMPING: f"{low}:{high}",
        },
        # Laws with advance knowledge of the speed receive the true speed.
        ties={target.replace("spindle_encoder", "learning_controller"): target for target in (_FREQUENCY, _AMPLITUDE)},
        sample=f"sobol:{parameters.points}",
        seeds=parameters.seeds,
    )
    columns = [_COUNTS, _FREQUENCY, _AMPLITUDE, _NOISE, _MODEL, "tool.max_errors"]
    (table,) = sweeps.table([("speed_deviation", base, space)], parameters.folder, columns, track)
    count = table.num_rows // len(laws)
    found = np.array([max(errors[-_JUDGED:]) if errors else np.inf for errors in table["tool.max_errors"].to_pylist()])
    of = {name: np.array(table[name].to_pylist(), float)[:count] for name in columns[:-1]}
    return BestLawResult(
        parameters,
        counts=of[_COUNTS],
        frequency=of[_FREQUENCY],
        amplitude=of[_AMPLITUDE],
        noise=of[_NOISE] * 1e9,
        model=of[_MODEL] / cast("float", base.value("electrodynamic_actuator.natural_frequency")),
        error={law: found[k * count : (k + 1) * count] * 1e6 for k, law in enumerate(laws)},
    )


STUDY = Study(
    "best-law",
    "which learning law errs least, over speed deviation, model error and sensors",
    BestLawParameters,
    run,
    size=(16.0, 7.0),
)
