# SPDX-License-Identifier: Apache-2.0
"""Report of a bag: one self-contained HTML page."""

import json
import os
import shlex
import tempfile
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import __version__, messages
from lathe_rc.analysis.budget import TOLD, Budget
from lathe_rc.analysis.metrology import Lay
from lathe_rc.bag.provenance import FILE, ORIGINS, SCENARIO, VERSIONS, origin, origins, scenario_of
from lathe_rc.bag.reading.source import name_of
from lathe_rc.cell.wiring import Cell
from lathe_rc.drawing.charts import Charts, page_template
from lathe_rc.drawing.pages import MOST_ROWS, PageTable, check_page, grid, printable, shown, write_page
from lathe_rc.errors import LatheError
from lathe_rc.judge.budget import budget
from lathe_rc.judge.loop_curves import LoopCurve, loop_curves
from lathe_rc.judge.part import along_in_words
from lathe_rc.view import report_figures as figures
from lathe_rc.view import report_loop
from lathe_rc.view.report_form import CUTOFF, FormByRevolution
from lathe_rc.view.report_gather import Gathered, gather
from lathe_rc.view.report_series import Envelope
from lathe_rc.view.report_verdict import assess

_LONGEST_SCENARIO = 200_000  # characters
_RPM = 60.0 / (2.0 * np.pi)
#: Signals that a page draws over time: field, name, axis, factor to the unit of the axis, and page about it.
SIGNALS = (
    ("speed_true", "Spindle speed", "speed [1/min]", _RPM, "docs/signals.md"),
    ("force", "Cutting force", "main cutting force [N]", 1.0, "docs/cutting.md"),
    ("wear", "Wear", "wear VB [µm]", 1e6, "docs/cutting.md"),
)


def _metrics(form: FormByRevolution) -> PageTable | None:
    rows = []
    for name, revolution in figures.shown_revolutions(form):
        numbers = revolution.numbers
        waves = f"{numbers['largest_upr']['upr']}: {shown(numbers['largest_upr']['amplitude'])}"
        values = (float(numbers[key]) for key in ("rms", "max", "peak_to_valley", "ront", "ronq"))
        rows.append([numbers["revolution"], name, *values, *map(float, numbers["centre"]), waves, float(numbers["ra"])])
    columns = ("revolution", "", "RMS", "max", "P-V", "RONt", "RONq", "centre x", "centre y", "largest UPR", "Ra")
    return grid(columns, rows, ("",))


def _form(form: FormByRevolution, cycles: Mapping[str, Envelope], maps: int, charts: Charts) -> dict[str, Any]:
    """Return the section of a tool; ``maps``: number of maps in the page."""
    if form.first is None:
        return {"form": form, "refused": form.refused or "the bag holds no complete revolution", "metrics": None}
    drawn = {
        "map": [figures.form_map(form, maps)],
        "polar": figures.polar(form),
        "spectrum": [figures.spectrum(form)],
        "convergence": [figures.convergence(form, cycles)],
    }
    refused, words = form.refused, ""
    if isinstance(form.surface, Lay):
        drawn["along"], words = figures.along(form.surface), along_in_words(form.surface)
    elif form.surface:
        refused = f"{refused} {form.surface}".strip()
    places = {name: charts.place(specs) for name, specs in drawn.items()}
    return {"form": form, "refused": refused, "metrics": _metrics(form), "along": None, "words": words, **places}


def _signals(data: Gathered, charts: Charts) -> Iterator[dict[str, Any]]:
    for field, name, unit, scale, page in SIGNALS:
        curves = {topic: series for (topic, own), series in data.curves.signals.items() if own == field and series.size}
        if curves:
            low, high = (np.array([series.extremes for series in curves.values()]) * scale).T
            ends = float(low.min()), float(high.max())
            constant = figures.almost_equal(*ends)  # a figure would show a line along an axis with one number
            drawn = [] if constant else [figures.against_time(data, curves, unit, scale)]
            yield {
                "name": name,
                "page": page,
                "places": charts.place(drawn) if drawn else [],
                "unit": unit,
                "low": shown(ends[0]),
                "high": shown(ends[1]),
                "group": max(series.group for series in curves.values()),
            }


def _servos(data: Gathered, charts: Charts) -> Iterator[dict[str, Any]]:
    """Return the section of each force or position loop."""
    for servo in data.servos:
        result, quantity = servo.result, servo.loop.quantity
        known = bool(result.found.errors.rms.size)
        courses = {"set point": servo.set_point, f"{servo.loop.name}, measured": servo.measured}
        drawn = {
            "error": [figures.servo_error(result)] if known else [],
            "course": [figures.against_time(data, courses, f"{servo.loop.name} [{quantity.unit}]", quantity.scale)],
            "command": [figures.against_time(data, {"command": servo.command}, "command", 1.0)],
        }
        rows = [[name, *result.row(place).values()] for name, place in (("first", 0), ("last", -1)) if known]
        columns = ("", "revolution", "RMS", "max", "P-V", "mean")
        yield {
            "loop": servo.loop,
            "limit": shown(servo.loop.limit),
            "refused": servo.refused,
            "numbers": grid(columns, rows, ("",)),
            "told": [*(text for text, _ in result.judged()), *result.behaviour()],
            **{name: charts.place(specs) if specs else None for name, specs in drawn.items()},
        }


def _nodes(data: Gathered) -> PageTable | None:
    levels = ("ok", "warning", "error", "stale")
    rows = (
        [
            name,
            node.reports,
            levels[node.level] if node.level < len(levels) else "?",
            *(printable(node.values.get(key, "–"), 20) for key in ("blocks", "lost blocks")),
            node.message,
        ]
        for name, node in data.host.nodes.items()
    )
    columns = ("node", "reports", "worst", "blocks", "lost", "message")
    return grid(columns, rows, ("node", "worst", "message"))


def losses(data: Gathered) -> list[str]:
    """Return rejected messages, losses and failures, one line each."""
    host = data.host
    found = [f"reading stopped: {data.stopped}"] if data.stopped else []
    for topic, tally in islice(data.topics.items(), MOST_ROWS):
        if tally.open_end and not data.stopped and not data.complete:  # a snapshot ends before the run does
            found.append(f"{topic} does not say that the run ends with its last block: the recording was cut off")
    found += [f"{name} lost {count} blocks" for name, count in host.lost_blocks.items()]
    found += host.errors
    found += [f"{form.tool}: {form.refused}" for form in data.forms if form.refused]
    found += [f"{servo.loop.node}: {servo.refused}" for servo in data.servos if servo.refused]
    if data.unjudged:
        found.append(f"no tolerance is known: {data.unjudged}")
    found += [f"another bag than the recorded one, {what}" for what in origin(data.about)]
    if host.unreadable:
        found.append(f"{host.unreadable} messages of host topics cannot be decoded")
    if host.left_out:
        found.append(f"{host.left_out} lines of host topics beyond those shown")
    return [printable(text) for text in found]


def _topics(data: Gathered) -> PageTable | None:
    dense = messages.block_types()
    rows = (
        [
            topic,
            tally.type.rpartition("/")[2],
            tally.count,
            data.samples if tally.type in dense else "",
            tally.rate,
            *(
                f"{(ns - messages.START_NS) * 1e-9:.4f}" if tally.count else "–"
                for ns in (tally.first_ns, tally.last_ns)
            ),
            f"{tally.size / 1e3:.0f}",
        ]
        for topic, tally in data.topics.items()
    )
    columns = ("topic", "type", "messages", "samples", "rate [1/s]", "from [s]", "to [s]", "kB")
    return grid(columns, rows, ("topic", "type"), len(data.topics))


def _events(data: Gathered) -> PageTable | None:
    rows = ([each.topic, each.sample, each.sample * data.step_ns * 1e-9, each.text] for each in data.curves.events)
    columns = ("topic", "sample", "time [s]", "action")
    return grid(columns, rows, ("topic", "action"), data.curves.event_count)


def _versions(data: Gathered) -> PageTable | None:
    try:
        given = json.loads(data.about.get(VERSIONS, ""))
    except (ValueError, RecursionError):
        return None
    columns = ("made with", "version")
    rows = [(name, str(version)) for name, version in given.items()] if isinstance(given, dict) else []
    return grid(columns, rows, columns, len(rows))


def _origins(data: Gathered) -> PageTable | None:
    found = origins(data.about)
    rows = ([origin.name, origin.package or "–", ", ".join(origin.used), origin.source] for origin in found)
    columns = ("class of others", "of", "used by", "source")
    return grid(columns, rows, columns, len(found))


def _about(data: Gathered) -> PageTable | None:
    rows = [
        (key, f"{len(text)} characters of base64" if key.startswith(FILE) else text)
        for key, text in sorted(data.about.items())
        if key not in (SCENARIO, VERSIONS, ORIGINS)
    ]
    return grid(("key", "text"), rows, ("key", "text"), len(rows))


def _budget(found: Budget) -> PageTable | None:
    rows = [[part.name, part.percent(), part.rms * 1e6, part.largest * 1e6] for part in found.rows]
    rows.append(["form error", "100.0", found.rms * 1e6, found.largest * 1e6])
    return grid(("cause", "share [%]", "RMS [µm]", "max [µm]"), rows, ("cause",))


def _facts(data: Gathered) -> Iterator[tuple[str, str, str]]:
    """Return the key figures at the top of the report: name, value and mood (CSS class)."""
    yield ("recording", "complete", "good") if data.complete else ("recording", "incomplete", "bad")
    yield "simulated", f"{data.seconds:.4g} s", ""
    yield "samples", f"{data.samples:,}".replace(",", " "), ""
    for form in data.forms[:1]:
        if form.first and form.last:
            yield "revolutions", str(form.rms.size), ""
            yield "RMS, first revolution", f"{shown(form.first.numbers['rms'])} µm", ""
            yield "RMS, last revolution", f"{shown(form.last.numbers['rms'])} µm", ""
    for servo in data.servos if not any(form.last for form in data.forms) else ():
        result = servo.result
        if result.found.errors.rms.size:
            last = result.row(-1)
            yield "revolutions", str(last["revolution"]), ""
            yield (
                f"{servo.loop.name} error, RMS, last revolution",
                f"{shown(last['rms'])} {servo.loop.quantity.unit}",
                "",
            )
    if data.run_id:
        yield "run", printable(data.run_id, 16), ""


def _loops(data: Gathered) -> tuple[list[LoopCurve], str]:
    """Return the loops of the bag's scenario, or the reason why they cannot be computed."""
    if SCENARIO not in data.about:
        return [], ""
    with tempfile.TemporaryDirectory(prefix="lathe-report-") as folder:
        try:
            cell = Cell(scenario_of(data.about, Path(folder)).nodes)
            cell.check(cures=False)
            return loop_curves(cell), ""
        except LatheError as error:
            return [], str(error)


def render(data: Gathered, name: str, command: str, made_of: Budget | None = None) -> str:
    """Return the report as an HTML page.

    Args:
        data: data gathered from the bag.
        name: name of the bag.
        command: command that reproduces the page.
        made_of: budget of the form error; None: no budget.
    """
    charts = Charts()
    template = page_template(Path(__file__).with_name("report.html.j2"), printable=printable)
    with np.errstate(over="ignore", invalid="ignore"):  # a bag may hold absurd numbers, which are shown unchanged
        cycles = {f"{topic}: {field}": found for (topic, field), found in data.curves.cycles.items() if found.size}
        forms = [_form(form, cycles, len(data.forms), charts) for form in data.forms]
        servos = list(_servos(data, charts))
        signals = list(_signals(data, charts))
        curves, unknown_loop = _loops(data)
        loops = [charts.place(report_loop.loop(curve)) for curve in curves]
        alone = cycles and not any(form["metrics"] for form in forms)
        text: str = template.render(
            title=f"Report of {printable(name, 80)}",
            command=printable(command),
            version=__version__,
            charts=charts,
            assessment=assess(data, losses(data), made_of),
            budget_hint=made_of is None and any(form.newest for form in data.forms[:1]),
            facts=_facts(data),
            missing=data.missing,
            made_of=made_of,
            least=TOLD,
            budget=_budget(made_of) if made_of else None,
            cutoff=f"{CUTOFF:.0f}",
            forms=forms,
            servos=servos,
            signals=signals,
            loops=loops,
            unknown_loop=unknown_loop,
            cycles=charts.place([figures.convergence(None, cycles)]) if alone else None,
            timing=charts.place(figures.timing(data.host, data.step_ns * 1e-9)) if len(data.host.pace) else None,
            host=data.host,
            nodes=_nodes(data),
            topics=_topics(data),
            events=_events(data),
            versions=_versions(data),
            origins=_origins(data),
            about=_about(data),
            scenario=printable(data.about.get(SCENARIO, ""), _LONGEST_SCENARIO),
        )
    return text


def write_report(bag: str | os.PathLike[str], page: str | os.PathLike[str], *, with_budget: bool = False) -> Gathered:
    """Write the report of a bag; an existing file of the same name is replaced atomically.

    Args:
        bag: path of the bag.
        page: path of the HTML file.
        with_budget: whether to add the budget of the form error, from runs of the bag's scenario.

    Raises:
        InputError: not a bag, or the page cannot be created; with a budget, the bag has no scenario for an offline run.
        LatheError: the page cannot be written, or a run of the budget failed.

    Example:
        >>> import lathe_rc
        >>> result = lathe_rc.run(lathe_rc.load("piston", ["spindle_encoder.revolutions=2"]), bag="piston_bag")
        >>> report = lathe_rc.write_report("piston_bag", "piston.html")
    """
    bag, page = Path(bag), Path(page)
    check_page(page)
    data = gather(bag)
    made_of = None
    if with_budget:
        with tempfile.TemporaryDirectory(prefix="lathe-report-") as folder:
            made_of = budget(scenario_of(data.about, Path(folder)))
    command = shlex.join(["lathe", "report", str(bag), *(["--budget"] if with_budget else []), "-o", str(page)])
    text = render(data, name_of(bag), command, made_of)
    write_page(page, text)
    return data
