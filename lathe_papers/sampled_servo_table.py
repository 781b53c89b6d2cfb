# SPDX-License-Identifier: Apache-2.0
"""Tables of the sampled-servo study, with computed and printed values of paper 003 side by side."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group
from rich.table import Table as RichTable

from lathe_machine.control.sampled_link import Link
from lathe_papers.formulas import sampled_loop
from lathe_papers.formulas.sampled_loop import Measures
from lathe_papers.sampled_servo_numbers import (
    DESIRED,
    PRINTED,
    PRINTED_PERIOD,
    PRINTED_SERIES,
    TERMS,
    first_crossing,
    numbers,
    stable,
)
from lathe_rc.study import comparison

if TYPE_CHECKING:
    from lathe_papers.sampled_servo_numbers import SampledServoNumbers

_SERIES_TOLERANCE = 0.01  # the printed terms have two digits


def _cell(found: Measures | None, place: int) -> str:
    """Format overshoot or settling time for a table cell."""
    if found is None:
        return "" if place else "unstable"
    value = numbers(found)[place]
    return "-" if value is None else f"{value:.{3 if place else 1}f}"


def _beside(printed: Sequence[float], n: int, computed: float) -> str:
    """Format a printed term, in brackets if it is wrong."""
    if n >= len(printed):
        return ""
    return f"{printed[n]:g}" if abs(printed[n] - computed) <= _SERIES_TOLERANCE else f"[{printed[n]:g}]"


def _polynomials(link: Link) -> str:
    """Format D(z) of a link of order zero or one."""
    if len(link.numerator) == 1:
        return f"{link.numerator[0]:g}"
    (gain, zero), (_, pole) = link.numerator, link.denominator
    return f"{gain:.4g}(z - {-zero / gain:.3f})/(z + {pole:.3f})"


def table(result: "SampledServoNumbers") -> Group:
    """Return tables of all numbers of the study beside the values printed in the paper."""
    parts = (_steps, _drives, _designs, _desired, _links, _gap, _series)
    pieces: list[RichTable | str] = [piece for part in parts for piece in (part(result), "")]
    return Group(*pieces[:-1])


def _steps(result: "SampledServoNumbers") -> RichTable:
    printed = result.parameters.as_printed
    analog = sampled_loop.measures(*result.analog)
    rows: list[Sequence[str]] = [
        ("analog", _cell(analog, 0), "", "4.3" if printed else "", _cell(analog, 1), "", "0.32" if printed else "")
    ]
    for row, as_p in zip(result.uncorrected, result.misread, strict=True):
        period, found = row.design.drive.period, row.measures
        paper = ("25", "0.7") if printed and period == PRINTED_PERIOD else ("", "")
        sigma, settling = ((_cell(found, place), _cell(as_p, place), paper[place]) for place in (0, 1))
        rows.append((f"T = {period:g} s", *sigma, *settling))
    title, crossing = "Step without a link: overshoot σ [%], settling t [s]", first_crossing(*result.analog)
    if np.isfinite(crossing):
        title += f";\nthe analog one first crosses 1 after {crossing / result.parameters.lag:.2f} T1"
    return comparison(
        f"{title} (paper: 4.7 T1)" if printed else title,
        ("loop", "σ", "jλ as p", "paper", "t", "jλ as p", "paper"),
        rows,
    )


def _drives(result: "SampledServoNumbers") -> RichTable:
    rows: list[Sequence[str]] = []
    for row in result.uncorrected:
        drive, pseudo = row.design.drive, sampled_loop.pseudo_frequency(row.design.drive)
        values = (drive.b1, drive.b0, drive.d, pseudo.zero, pseudo.pole)
        rows.append((f"{drive.period:g}", *(f"{value:.4f}" for value in values)))
        if result.parameters.as_printed and drive.period == PRINTED_PERIOD:
            rows.append(("paper 003", "0.611", "0.325", "0.134", "0.024", "0.105"))
    return comparison(
        "W(z) = (b1·z + b0)/((z - 1)(z - d)),\nW(jλ) = K(1 - jλT/2)(1 + jλT2)/(jλ(1 + jλT3))",
        ("T [s]", "b1", "b0", "d", "T2 [s]", "T3 [s]"),
        rows,
    )


def _designs(result: "SampledServoNumbers") -> RichTable:
    return comparison(
        "Links, largest pole of the loop, gain and phase margin",
        ("link", "T [s]", "D(z)", "pole", "gain", "phase"),
        [
            (
                name,
                f"{row.design.drive.period:g}",
                _polynomials(row.design.link),
                f"{np.abs(row.design.poles).max():.3f}",
                f"{20.0 * np.log10(row.design.gain_margin):.1f} dB" if row.design.stable else "",
                f"{np.degrees(row.design.phase_margin):.0f}°" if row.design.stable else "",
            )
            for name, rows in result.all_links()
            for row in rows
        ],
    )


def _desired(result: "SampledServoNumbers") -> RichTable:
    rows: list[Sequence[str]] = []
    for row in result.rows:
        printed = ("", "")
        if row.printed is not None:
            printed = (f"{row.printed[0]:g}", f"{row.printed[1]:g}")
        elif result.parameters.as_printed and row.half_period in PRINTED:
            printed = ("unstable", "")
        sigma, settling = (_cell(row.continuous, place) for place in (0, 1))
        rows.append(
            (
                f"{row.half_period:g}", f"{row.ratio:g}", sigma, printed[0], _cell(row.true, 0),
                settling, printed[1], _cell(row.true, 1),
            )
        )  # fmt: skip
    return comparison(
        "Desired function with jλ read as p, and the drive with the link of that\n"
        "function, between samples too; overshoot σ [%], settling t [s]",
        ("T/2 [s]", "ρ", "σ as p", "printed", "σ drive", "t as p", "printed", "t drive"),
        rows,
    )


def _links(result: "SampledServoNumbers") -> RichTable:
    late = f"{result.parameters.delay_ms:g} ms late"
    return comparison(
        "Links on the drive, between samples too; peak: largest command",
        ("link", "T [s]", "σ [%]", "t [s]", "peak", f"σ, {late}", "if known"),
        [
            (
                name,
                f"{row.design.drive.period:g}",
                _cell(row.measures, 0),
                _cell(row.measures, 1),
                "" if row.step is None else f"{np.abs(row.step.command).max():.3g}",
                _cell(row.late, 0),
                "" if row.late_known is None else _cell(row.late_known, 0),
            )
            for name, rows in result.all_links()
            for row in rows
        ],
    )


def _gap(result: "SampledServoNumbers") -> RichTable:
    return comparison(
        f"Load behind a gap of {result.parameters.backlash:g} of the step: how often it is taken back, what\n"
        "it lacks in the end; measured at the motor or at the load",
        ("link", "T [s]", "back, motor", "back, load", "lacks, motor", "lacks, load"),
        [
            (
                name,
                f"{row.design.drive.period:g}",
                *(str(step.reversals) for step in (row.motor, row.load)),
                *(f"{round(step.offset, 4) + 0.0:.4f}" for step in (row.motor, row.load)),
            )
            for name, rows in result.all_links()
            for row in rows
            if row.motor is not None and row.load is not None
        ],
    )


def _series(result: "SampledServoNumbers") -> RichTable:
    names = [f"Wж{n}" for n in range(1, len(DESIRED) + 1)]
    columns = [part for name in names for part in (name, "printed")]
    rows: list[Sequence[str]] = [
        ("", *(part for function in DESIRED for part in ("stable" if stable(function) else "unstable", "")))
    ]
    for n in range(1, TERMS):
        cells = [
            (f"{terms[n]:.3f}", _beside(printed, n, terms[n]))
            for terms, printed in zip(result.computed, PRINTED_SERIES, strict=True)
        ]
        rows.append((str(n), *(cell for pair in cells for cell in pair)))
    return comparison("X[nT] of eqs 5-7; printed terms in brackets are wrong", ("n", *columns), rows)
