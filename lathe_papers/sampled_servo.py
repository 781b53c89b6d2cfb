# SPDX-License-Identifier: Apache-2.0
"""Sampled position servo of paper 003: its table, Figs 2-4 and series, compared with the simulated servo.

The table of the paper gives the step response of the desired function with the pseudo-frequency treated as a frequency.
It is compared with the drive and the link that produces this function, including the motion between samples. The link
of the paper is compared with a ripple-free link, both on a drive with backlash.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lathe_machine.control.sampled_link import NONE, Link, SampledDrive, paper, ripple_free, towards
from lathe_papers import sampled_servo_figure, sampled_servo_table
from lathe_papers.formulas import sampled_loop
from lathe_papers.formulas.sampled_loop import Measures, PseudoFrequency
from lathe_papers.sampled_servo_numbers import (
    DESIRED,
    FEEDBACKS,
    PRINTED,
    RATIOS,
    TERMS,
    LinkRow,
    SampledServoNumbers,
    SampledServoParameters,
    ServoRow,
)
from lathe_rc.arrays import Array
from lathe_rc.study import Study, Track, untracked

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Group

_BACKLASH_PERIODS = 60  # number of periods; the poles do not give the settling time of a loop with backlash


@dataclass(frozen=True)
class SampledServoResult(SampledServoNumbers):
    """Result of the sampled-servo study, with table and figures (numbers in `SampledServoNumbers`)."""

    def table(self) -> "Group":
        """Return tables of all numbers beside the printed values."""
        return sampled_servo_table.table(self)

    def draw(self, figure: "Figure") -> None:
        """Draw Figs 2-4 of the paper, with the motion between samples and with backlash."""
        sampled_servo_figure.draw(self, figure)


def _as_continuous(function: PseudoFrequency, time: Array) -> Measures | None:
    """Return the measures of the closed loop with jλ replaced by p; None if it is unstable."""
    response = sampled_loop.continuous_step(*function.as_continuous(), time)
    return None if response is None else sampled_loop.measures(time, response)


def _table_row(drive: SampledDrive, ratio: float, time: Array, printed: tuple[float, float] | None) -> ServoRow:
    link = towards(drive, ratio)
    periods = sampled_loop.periods_to_settle(drive, link)
    true = None
    if periods is not None:
        step = sampled_loop.step_response(drive, link, periods=periods)
        true = sampled_loop.measures(step.time, step.load)
    return ServoRow(drive.period / 2.0, ratio, _as_continuous(sampled_loop.desired(drive, ratio), time), true, printed)


def _late(drive: SampledDrive, link: Link, delay: float) -> Measures | None:
    periods = sampled_loop.periods_to_settle(drive, link, delay)
    if periods is None:
        return None
    step = sampled_loop.step_response(drive, link, periods=periods, delay=delay)
    return sampled_loop.measures(step.time, step.load)


def _link_row(
    drive: SampledDrive, link: Link, known: Link | None, given: SampledServoParameters, delay: float
) -> LinkRow:
    periods = sampled_loop.periods_to_settle(drive, link)
    design = sampled_loop.report(drive, link)
    if periods is None:
        return LinkRow(design, None, None, None, None, None)
    at_motor, at_load = (
        sampled_loop.step_response(
            drive, link, periods=max(periods, _BACKLASH_PERIODS), backlash=given.backlash, feedback=feedback
        )
        for feedback in FEEDBACKS
    )
    return LinkRow(
        design,
        sampled_loop.step_response(drive, link, periods=periods),
        at_motor,
        at_load,
        _late(drive, link, delay),
        None if known is None else _late(drive, known, delay),
    )


def run(parameters: SampledServoParameters, track: Track = untracked) -> SampledServoResult:
    """Compute the table, the series, and the links with and without backlash."""
    rows, uncorrected, misread = [], [], []
    time = parameters.time
    links: dict[str, list[LinkRow]] = {"paper": [], "ripple_free": []}
    for period in track(parameters.t):
        drive = SampledDrive(parameters.gain, parameters.lag, period)
        printed = PRINTED.get(round(period / 2.0, 9)) if parameters.as_printed else None
        rows += [
            _table_row(drive, ratio, time, paper_says)
            for ratio, paper_says in zip(RATIOS, printed or [None] * len(RATIOS), strict=True)
        ]
        # The simulation supports only whole steps.
        step = period / sampled_loop.STEPS
        delay = min(round(parameters.delay_ms * 1e-3 / step) * step, period)
        uncorrected.append(_link_row(drive, NONE, None, parameters, delay))
        misread.append(_as_continuous(sampled_loop.pseudo_frequency(drive), time))
        links["paper"].append(_link_row(drive, paper(drive), None, parameters, delay))
        links["ripple_free"].append(_link_row(drive, ripple_free(drive), ripple_free(drive, delay), parameters, delay))
    bottom = np.array([parameters.lag, 1.0, parameters.gain])
    analog = sampled_loop.continuous_step(np.array([parameters.gain]), bottom, time)
    return SampledServoResult(
        parameters,
        np.array([time, analog]),
        tuple(rows),
        tuple(uncorrected),
        tuple(misread),
        {name: tuple(found) for name, found in links.items()},
        tuple(sampled_loop.series(*function.closed(), TERMS) for function in DESIRED),
    )


STUDY = Study(
    "sampled-servo",
    "sampled position servo: the table and Figs 2-4 of paper 003, what the drive really does, a link without ripple",
    SampledServoParameters,
    run,
    size=(14.0, 8.0),
)
