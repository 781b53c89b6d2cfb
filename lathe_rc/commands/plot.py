# SPDX-License-Identifier: Apache-2.0
"""Terminal plot of the form error by revolution."""

import math
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.text import Text

from lathe_rc import harness

_ROWS = 12  # approximate height of the plot without frame and ticks [lines]
_FRAME = 3  # lines of frame and ticks
_NARROWEST = 40  # smallest width of the plot [characters]
_POINTS = 4  # points of a curve per character of width
_STYLES = {"gray+": "white", "cyan+": "bright_cyan", "orange+": "bright_yellow"}  # styles of rich, by plotext's colours


def shown(result: harness.Result, console: Console) -> Iterator[Text]:
    """Yield the plot if the output is a terminal that can display it, not a pipe or a file."""
    seen = console.file.isatty() and not console.is_dumb_terminal and console.width >= _NARROWEST
    if seen and (text := drawn(result, console.width)):
        yield text


def drawn(result: harness.Result, width: int) -> Text | None:
    """Return the plot with a legend line above it; None if there are fewer than two revolutions.

    Args:
        result: result of the run.
        width: width of the plot [characters].
    """
    import plotext  # slow to import, and not needed without a plot

    rms, largest = np.asarray(result.errors.rms) * 1e6, np.asarray(result.errors.largest) * 1e6
    if rms.size < 2 or not (np.isfinite(largest).all() and rms.all()):
        return None
    first = result.recording.turns_before + 1
    groups = np.array_split(np.arange(rms.size), min(rms.size, _POINTS * width))
    revolution = [first + int(group[-1]) for group in groups]
    curves = [("largest", "gray+", largest), ("RMS", "cyan+", rms)]
    if result.verdict and not result.verdict.zones:
        limit = result.verdict.tolerance * 1e6
        curves.insert(0, (f"tolerance {limit:.4g} µm", "orange+", np.full(rms.size, limit)))
    plotext.clear_figure()  # the figure is global
    plotext.limit_size(False, False)  # noqa: FBT003 - so it is called
    for part in (plotext.canvas_color, plotext.axes_color, plotext.ticks_color):
        part("default")
    named = Text("form error [µm] by revolution: ")
    for label, colour, values in curves:
        decades = [math.log10(values[group].max()) for group in groups]
        plotext.plot(revolution, decades, marker="braille", color=colour)
        named.append(f" ━ {label}", style=_STYLES[colour])
    ticks = _decades(min(values.min() for *_, values in curves), max(values.max() for *_, values in curves))
    count = len(ticks) - 1
    # Each power of ten is in the middle of a line, so that curves pass its label on the right side.
    plotext.plot_size(width, count * max(1, round(_ROWS / count)) + 1 + _FRAME)
    plotext.ylim(ticks[0], ticks[-1])
    plotext.yticks(ticks, [f"{10.0**tick:g}" for tick in ticks])
    across = np.unique(np.linspace(revolution[0], revolution[-1], max(2, width // 12)).round().astype(int)).tolist()
    plotext.xticks(across, [str(tick) for tick in across])
    plot = Text.from_ansi(str(plotext.build()))
    plotext.clear_figure()
    return named.append("\n").append_text(plot)


def _decades(low: float, high: float) -> list[int]:
    """Return the exponents of the powers of ten that enclose the values."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    return list(range(first, max(last, first + 1) + 1))
