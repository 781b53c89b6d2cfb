# SPDX-License-Identifier: Apache-2.0
"""Several runs side by side: one self-contained HTML page, made from their bags."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import __version__
from lathe_rc.drawing.charts import Charts, page_template
from lathe_rc.drawing.pages import PageTable, check_page, grid, printable, write_page
from lathe_rc.errors import InputError
from lathe_rc.judge.loops import FIGURES
from lathe_rc.view import compare_figures as figures
from lathe_rc.view import report_figures
from lathe_rc.view.report import SIGNALS, losses
from lathe_rc.view.report_form import FormByRevolution
from lathe_rc.view.report_gather import Gathered, gather
from lathe_rc.view.report_servo import Servo
from lathe_rc.view.report_verdict import assess

_MOST = 6  # runs, as many as there are colours
_ABSENT = "–"
#: figures of a loop in the table, and their headings
_SERVO_FIGURES = {
    "steady_error": "steady error",
    "steady_deviation": "deviation",
    "overshoot": "overshoot",
    "settling": "settling [s]",
    "saturated": "at limits [1]",
}


def _forms(runs: Mapping[str, Gathered]) -> dict[str, FormByRevolution]:
    """Return the form of the first tool of each run that has complete revolutions."""
    return {name: data.forms[0] for name, data in runs.items() if data.forms and data.forms[0].last}


def _results(runs: Mapping[str, Gathered], forms: Mapping[str, FormByRevolution]) -> PageTable | None:
    rows = []
    for name, data in runs.items():
        found = assess(data, losses(data), None)
        form = forms.get(name)
        revolutions = (form.first, form.best, form.last) if form else ()
        numbers = [float(each.numbers["rms"]) if each else np.nan for each in revolutions] or [np.nan] * 3
        largest = float(form.last.numbers["max"]) if form and form.last else np.nan
        wrong = found.wrong[0].text if found.wrong else ""
        more = f" and {len(found.wrong) - 1} more" if len(found.wrong) > 1 else ""
        turns = form.rms.size if form else max((each.result.found.errors.rms.size for each in data.servos), default=0)
        rows.append([name, turns, *numbers, largest, found.verdict.text, wrong + more])
    columns = ["run", "revolutions", "RMS first", "RMS best", "RMS last", "max last", "verdict", "what went wrong"]
    if not forms:
        columns, rows = [*columns[:2], *columns[6:]], [[*row[:2], *row[6:]] for row in rows]
    return grid(columns, rows, ("run", "verdict", "what went wrong"))


Servos = Mapping[str, Mapping[str, Servo]]  #: loops with a complete revolution, by controller and run


def _servos(runs: Mapping[str, Gathered]) -> Servos:
    nodes = dict.fromkeys(servo.loop.node for data in runs.values() for servo in data.servos)
    found = {
        node: {
            name: servo
            for name, data in runs.items()
            for servo in data.servos
            if servo.loop.node == node and servo.result.found.errors.rms.size
        }
        for node in nodes
    }
    return {node: servos for node, servos in found.items() if servos}


def _servo_results(servos: Servos) -> PageTable | None:
    rows = []
    for node, by_run in servos.items():
        for name, servo in by_run.items():
            result, quantity = servo.result, servo.loop.quantity
            first, last = result.row(0), result.row(-1)
            told = [of(result) for of, _ in (FIGURES[each] for each in _SERVO_FIGURES)]
            scales = [quantity.scale if not FIGURES[each][1] else 1.0 for each in _SERVO_FIGURES]
            more = [np.nan if value is None else value * scale for value, scale in zip(told, scales, strict=True)]
            rows.append([f"{node} [{quantity.unit}]", name, first["rms"], last["rms"], last["max"], *more])
    columns = ("controller", "run", "RMS first", "RMS last", "max last", *_SERVO_FIGURES.values())
    return grid(columns, rows, ("controller", "run"))


def _servo_figures(
    runs: Mapping[str, Gathered], servos: Servos, shown: int, charts: Charts
) -> Iterator[dict[str, Any]]:
    """Yield the figures of each controller: error by revolution, course and command of all runs."""
    for node, by_run in servos.items():
        name, first = next(iter(by_run.items()))
        loop, against_time = first.loop, report_figures.against_time
        courses = {run: servo.measured for run, servo in by_run.items()} | {"set point": first.set_point}
        commands = {run: servo.command for run, servo in by_run.items()}
        unit = f"{loop.name} [{loop.quantity.unit}]"
        drawn = {
            "error": figures.servo_error({run: servo.result for run, servo in by_run.items()}, shown),
            "course": against_time(runs[name], courses, unit, loop.quantity.scale),
            "command": against_time(runs[name], commands, "command", 1.0),
        }
        yield {"node": node, "loop": loop, "run": name, **{each: charts.place([spec]) for each, spec in drawn.items()}}


def _parameters(runs: Mapping[str, Gathered]) -> tuple[PageTable | None, PageTable | None]:
    """Return the parameters that differ, as the scenarios of the bags give them: of nodes of all runs, of some only."""
    scenarios = [data.nodes for data in runs.values()]
    names = {(node, name) for nodes in scenarios for node, values in nodes.items() for name in values}
    common, further = list[list[str]](), list[list[str]]()
    for node, name in sorted(name for name in names if name[1] != "run_id"):
        values = [str(nodes.get(node, {}).get(name, _ABSENT)) for nodes in scenarios]
        if len(set(values)) > 1:
            (common if all(node in nodes for nodes in scenarios) else further).append([f"{node}.{name}", *values])
    columns = ("parameter", *runs)
    return grid(columns, common, columns, len(common)), grid(columns, further, columns, len(further))


def _signals(runs: Mapping[str, Gathered], charts: Charts) -> Iterator[dict[str, Any]]:
    """Yield a figure of each plotted signal that any of the runs has."""
    for field, name, unit, scale, page in SIGNALS:
        drawn = {
            f"{run}: {topic}" if len(data.forms) > 1 else run: (data, series)
            for run, data in runs.items()
            for (topic, own), series in data.curves.signals.items()
            if own == field and series.size
        }
        if drawn:
            first = next(iter(drawn.values()))[0]
            curves = {label: series for label, (_, series) in drawn.items()}
            yield {
                "name": name,
                "page": page,
                "places": charts.place([report_figures.against_time(first, curves, unit, scale)]),
            }


def render(runs: Mapping[str, Gathered], command: str) -> str:
    """Return the page.

    Args:
        runs: data of each run by its name, at least two.
        command: command that reproduces the page.
    """
    charts = Charts()
    template = page_template(Path(__file__).with_name("compare.html.j2"), printable=printable)
    with np.errstate(over="ignore", invalid="ignore"):  # a bag may hold absurd numbers, which are shown unchanged
        forms = _forms(runs)
        tolerance = max((form.tolerances.tolerance for form in forms.values()), default=0.0)
        together = figures.compared(forms, tolerance, [name for name in forms if runs[name].doubt]) if forms else None
        servos = _servos(runs)
        ends = [each.result.found.errors.rms.size for by_run in servos.values() for each in by_run.values()]
        shown = together.shown if together else min(ends, default=1)
        places = {}
        if together:
            charts.data.update(together.data)
            drawn = {
                "verdicts": [figures.verdicts(together)],
                "convergence": [figures.convergence(together)],
                "maps": figures.maps(together),
                "profile": [figures.profile(together)],
                "polar": [figures.polar(together)],
                "spectrum": [figures.spectrum(together)],
            }
            places = {name: charts.place(specs) for name, specs in drawn.items()}
        text: str = template.render(
            title=f"Comparison of {printable(', '.join(runs), 200)}",
            command=printable(command),
            version=__version__,
            charts=charts,
            results=_results(runs, forms),
            parameters=_parameters(runs),
            unknown=[name for name, data in runs.items() if not data.nodes],
            first=next(iter(runs)),
            together=together,
            formless=[name for name in runs if name not in forms],
            figures=places,
            shown=shown,
            revolutions=max([together.revolutions if together else 1, *ends]),
            servos=list(_servo_figures(runs, servos, shown, charts)),
            servo_results=_servo_results(servos),
            signals=list(_signals(runs, charts)),
        )
    return text


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return a short name of each path: the last part, or the whole path where that is not unique.

    Raises:
        InputError: a path is given twice.
    """
    short = [path.stem if path.suffix else path.name for path in paths]
    names = [name if short.count(name) == 1 else str(path) for name, path in zip(short, paths, strict=True)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise InputError(f"{twice} is given twice; allowed: different runs")
    return names


def check(bags: Mapping[str, Path], page: Path) -> None:
    """Refuse a comparison that cannot be written.

    Raises:
        InputError: fewer than two runs or more than six, or the page cannot be created.
    """
    if not 2 <= len(bags) <= _MOST:
        raise InputError(f"runs to compare: {len(bags)}; allowed: 2 to {_MOST}")
    check_page(page)


def write_comparison(bags: Mapping[str, Path], page: Path, given: Sequence[str]) -> None:
    """Write the comparison of several bags, which `check` accepts.

    Args:
        bags: path of each bag by the name of its run.
        page: path of the HTML file.
        given: arguments of the command that reproduces the page.

    Raises:
        InputError: not a bag.
        LatheError: the page cannot be written.
    """
    runs = {name: gather(bag) for name, bag in bags.items()}
    write_page(page, render(runs, shlex.join(["lathe", "compare", *given, "-o", str(page)])))
