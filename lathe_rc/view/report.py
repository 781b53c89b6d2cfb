# SPDX-License-Identifier: Apache-2.0
"""A bag as one HTML page that needs nothing else.

Whatever comes from the bag is somebody else's text: it is escaped by the template, cut to a length, and shown without
characters that do not print.

Longer than 400 lines: each table and picture of the page has its function here, in the order of the page.
"""

import json
import os
import shlex
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import matplotlib as mpl
import numpy as np

from lathe_rc import __version__, messages
from lathe_rc.analysis.budget import TOLD, Budget
from lathe_rc.analysis.metrology import Lay
from lathe_rc.bag.provenance import FILE, ORIGINS, RECOVERED, SCENARIO, VERSIONS, origins, scenario_of
from lathe_rc.bag.reading.source import name_of
from lathe_rc.cell.budget import budget
from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import check_place, replacing
from lathe_rc.part import along_in_words
from lathe_rc.view import report_charts as charts
from lathe_rc.view import report_figures as figures
from lathe_rc.view.charts import Charts, Spec
from lathe_rc.view.page_template import page_template
from lathe_rc.view.report_form import CUTOFF, Form
from lathe_rc.view.report_gather import Gathered, gather
from lathe_rc.view.report_series import Envelope
from lathe_rc.view.report_verdict import hint, judged

_LONGEST_SCENARIO = 200_000  # characters
_LONGEST_TEXT = 300
_MOST_ROWS = 200
_RPM = 60.0 / (2.0 * np.pi)


@dataclass(frozen=True)
class Fact:
    """A figure of the run, at the top."""

    name: str
    value: str
    mood: str = ""


@dataclass
class Picture:
    """A figure with what it shows and where its formula is.

    Attributes:
        name, caption, page: see above.
        image: for paper, and where no script runs.
        specs: what takes its place on a screen, see `Charts`; side by side if there are several.
        places: their names on the page.
    """

    name: str
    image: str
    caption: str
    page: str
    specs: Sequence[Spec]
    places: Sequence[str] = ()


@dataclass(frozen=True)
class Grid:
    """A table; ``texts`` are the columns that are no numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str
    page: str
    texts: Sequence[str] = ()


@dataclass(frozen=True)
class FormSection:
    """The figures of one tool."""

    tool: str
    refused: str
    metrics: Grid | None
    figures: Sequence[Picture]


def printable(text: str, longest: int = _LONGEST_TEXT) -> str:
    """A text from a bag: of bounded length, and of what prints, line ends and tabs."""
    cut = text[:longest] + (f" … ({len(text)} characters)" if len(text) > longest else "")
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "\ufffd" for letter in cut)


def _number(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else "–"


def _cut(rows: Iterable[Sequence[str]], count: int) -> list[Sequence[str]]:
    """The first rows, and how many there are more."""
    shown_rows = list(islice(rows, _MOST_ROWS))
    return [*shown_rows, [f"… and {count - _MOST_ROWS} more"]] if count > _MOST_ROWS else shown_rows


def _metrics(form: Form) -> Grid:
    columns = ("revolution", "", "RMS", "max", "P-V", "RONt", "RONq", "centre x", "centre y", "largest UPR", "Ra")
    rows = []
    for name, _, revolution in figures.shown_revolutions(form):
        told = revolution.numbers
        upr = told["largest_upr"]
        values = [told["rms"], told["max"], told["peak_to_valley"], told["ront"], told["ronq"], *told["centre"]]
        waves = f"{upr['upr']}: {_number(upr['amplitude'])}"
        rows.append([str(told["revolution"]), name, *map(_number, values), waves, _number(told["ra"])])
    caption = (
        "In µm. RMS, max and P-V of the form error; RONt and RONq from the least-squares circle, with centre x, y; "
        f"filters at {CUTOFF:.0f} UPR (undulations per revolution). Best is the smallest RMS of "
        f"{form.rms.size} revolutions."
    )
    return Grid(columns, rows, caption, "docs/metrology.md", ("",))


def _form(form: Form, cycles: Mapping[str, Envelope], maps: int) -> FormSection:
    refused = printable(form.refused)
    if form.first is None:
        return FormSection(printable(form.tool), refused or "the bag holds no complete revolution", None, ())
    grouped = f" Each line is the mean of {form.map.group} revolutions." if form.map.group > 1 else ""
    page = "docs/metrology.md"
    pictures = [
        Picture(
            "Error map",
            figures.form_map(form),
            "Radius of the part less desired radius over spindle angle and revolution; red: material left. The colours "
            "are linear around zero and logarithmic beyond the largest of the quietest quarter of revolutions."
            f"{grouped}",
            page,
            [charts.form_map(form, maps)],
        ),
        Picture(
            "First and last revolution",
            figures.polar(form),
            "Radius deviation around the part, each in its own scale; dashed: the desired form.",
            page,
            charts.polar(form),
        ),
        Picture(
            "Error spectrum",
            figures.spectrum(form),
            "Amplitude A_n of r = Σ A_n·sin(nφ + ψ_n) by undulations per revolution n of the first, best and last "
            "revolution.",
            page,
            [charts.spectrum(form)],
        ),
        Picture(
            "Convergence",
            figures.convergence(form, cycles),
            "RMS over the angle and largest magnitude of the true form error by revolution; dots: what each controller "
            "measured in its own cycles, which begin and end elsewhere.",
            f"{page}, docs/learning.md",
            [charts.convergence(form, cycles)],
        ),
    ]
    if isinstance(form.surface, Lay):
        told = along_in_words(form.surface)
        caption = f"{told[0].upper()}{told[1:]}. What nose and feed leave, by the tool's nose_radius."
        along = figures.along(form.surface), caption, page, charts.along(form.surface)
        pictures.append(Picture("Surface along the part", *along))
    elif form.surface:
        refused = f"{refused} {form.surface}".strip()
    return FormSection(printable(form.tool), refused, _metrics(form), pictures)


def _signals(told: Gathered) -> list[Picture]:
    kinds = (
        ("speed_true", "Spindle speed", "speed [1/min]", _RPM, "docs/signals.md"),
        ("force", "Cutting force", "main cutting force [N]", 1.0, "docs/cutting.md"),
        ("wear", "Wear", "wear VB [µm]", 1e6, "docs/cutting.md"),
    )
    pictures = []
    for field, name, unit, scale, page in kinds:
        curves: dict[str, Envelope] = {
            topic: series for (topic, own), series in told.curves.signals.items() if own == field and series.size
        }
        if curves:
            low, high = (np.array([series.extremes for series in curves.values()]) * scale).T
            caption = f"True values, {_number(float(low.min()))} to {_number(float(high.max()))}."
            group = max(series.group for series in curves.values())
            if group > 1:
                caption += f" The band spans the extremes of {group} samples each, the line is its middle."
            drawn = figures.against_time(told, curves, unit, scale)
            pictures.append(Picture(name, drawn, caption, page, [charts.against_time(told, curves, unit, scale)]))
    return pictures


def _timing(told: Gathered) -> Picture | None:
    host = told.host
    if not host.pace.size:
        return None
    caption = (
        f"Pace: simulated time by wall time, in {host.pace.size} intervals between reports of the time master on "
        "/diagnostics. Lateness: from the moment at which a block was due to that at which the time master let it go; "
        "only where the speed is given. Latency: from there until the time master had heard that every member had "
        "completed the block; members report several blocks at a time."
    )
    step = told.step_ns * 1e-9
    drawn, specs = figures.timing(host, step), charts.timing(host, step)
    return Picture("Pace, lateness and latency", drawn, caption, "docs/cell.md", specs)


def _nodes(told: Gathered) -> Grid | None:
    host = told.host
    if not host.nodes:
        return None
    levels = ("ok", "warning", "error", "stale")
    rows = [
        [
            printable(name),
            str(node.reports),
            levels[node.level] if node.level < len(levels) else "?",
            printable(node.values.get("blocks", "–"), 20),
            printable(node.values.get("lost blocks", "–"), 20),
            printable(node.message),
        ]
        for name, node in host.nodes.items()
    ]
    caption = "From /diagnostics: the worst level of all reports, the rest as last reported."
    columns = ("node", "reports", "worst", "blocks", "lost", "message")
    return Grid(columns, rows, caption, "docs/cell.md", ("node", "worst", "message"))


def losses(told: Gathered) -> list[str]:
    """Refusals, losses and failures, a line each."""
    host = told.host
    found = [f"reading stopped: {told.stopped}"] if told.stopped else []
    for topic, tally in islice(told.topics.items(), _MOST_ROWS):
        if tally.open_end and not told.stopped and not told.complete:  # a snapshot ends before the run
            found.append(f"{topic} does not say that the run ends with its last block: the recording was cut off")
    found += [f"{name} lost {count} blocks" for name, count in host.lost_blocks.items()]
    found += host.errors
    found += [f"{form.tool}: {form.refused}" for form in told.forms if form.refused]
    found += [f"no tolerance is known: {told.unjudged}"] if told.unjudged else []
    if told.about.get(RECOVERED):
        found.append(f"the bag was cut off and has been recovered: {told.about[RECOVERED]}")
    if host.unreadable:
        found.append(f"{host.unreadable} messages of host topics cannot be decoded")
    if host.left_out:
        found.append(f"{host.left_out} lines of host topics beyond those shown")
    return [printable(text) for text in found]


def _topics(told: Gathered) -> Grid:
    columns = ("topic", "type", "messages", "samples", "rate [1/s]", "from [s]", "to [s]", "kB")
    texts = ("topic", "type")
    dense = messages.block_types()

    def at(ns: int) -> str:
        return f"{(ns - messages.START_NS) * 1e-9:.4f}"

    rows = (
        [
            printable(topic),
            printable(tally.type.rpartition("/")[2]),
            str(tally.count),
            str(told.samples) if tally.type in dense else "",
            _number(tally.rate),
            *((at(tally.first_ns), at(tally.last_ns)) if tally.count else ("–", "–")),
            f"{tally.size / 1e3:.0f}",
        ]
        for topic, tally in told.topics.items()
    )
    caption = (
        "Counted while reading. Rate: messages by simulated time between the first and the last; times are log times "
        "since sample 0."
    )
    return Grid(columns, _cut(rows, len(told.topics)), caption, "docs/bags.md", texts)


def _events(told: Gathered) -> Grid | None:
    if not told.curves.events:
        return None
    rows: list[Sequence[str]] = [
        [printable(event.topic), str(event.sample), _number(event.sample * told.step_ns * 1e-9), printable(event.text)]
        for event in told.curves.events
    ]
    if told.curves.event_count > len(rows):
        rows.append([f"… and {told.curves.event_count - len(rows)} more"])
    columns = ("topic", "sample", "time [s]", "action")
    return Grid(columns, rows, "Time since sample 0.", "docs/cell.md", ("topic", "action"))


def _versions(told: Gathered) -> Grid | None:
    try:
        given = json.loads(told.about.get(VERSIONS, ""))
    except (ValueError, RecursionError):
        return None
    if not isinstance(given, dict) or not given:
        return None
    rows = ([printable(name), printable(str(number))] for name, number in given.items())
    return Grid(("made with", "version"), _cut(rows, len(given)), "", "docs/bags.md", ("made with", "version"))


def _origins(told: Gathered) -> Grid | None:
    found = origins(told.about)
    if not found:
        return None
    rows = (
        [printable(text) for text in (origin.name, origin.package or "–", ", ".join(origin.used), origin.source)]
        for origin in found
    )
    columns = ("class of others", "of", "used by", "source")
    return Grid(columns, _cut(rows, len(found)), "Source: its SHA-256.", "docs/extending.md", columns)


def _about(told: Gathered) -> Grid | None:
    given = {key: text for key, text in told.about.items() if key not in (SCENARIO, VERSIONS, ORIGINS)}
    if not given:
        return None
    rows = (
        [printable(key), f"{len(text)} characters of base64" if key.startswith(FILE) else printable(text)]
        for key, text in sorted(given.items())
    )
    caption = "Further metadata of the bag."
    return Grid(("key", "text"), _cut(rows, len(given)), caption, "docs/bags.md", ("key", "text"))


def _budget(found: Budget) -> Grid:
    rows = [[part.name, part.percent(), _number(part.rms * 1e6), _number(part.largest * 1e6)] for part in found.rows]
    rows.append(["form error", "100.0", _number(found.rms * 1e6), _number(found.largest * 1e6)])
    caption = (
        f"Form error of the last {found.revolutions} revolutions, from runs of the bag's scenario offline with causes "
        "switched off: share in its power, and size of each part by itself. Causes, rest and interactions add up; "
        f"pairs of causes are parts of the interactions, those below {TOLD:.0%} are left out."
    )
    left_out = "".join(f" Not switched off: {name}: {printable(why)}." for name, why in found.left_out.items())
    return Grid(
        ("cause", "share [%]", "RMS [µm]", "max [µm]"), rows, caption + left_out, "docs/metrology.md", ("cause",)
    )


def _budgeted(told: Gathered) -> Budget:
    """The budget of the scenario that a bag holds."""
    with tempfile.TemporaryDirectory(prefix="lathe-report-") as folder:
        return budget(scenario_of(told.about, Path(folder)))


def _facts(told: Gathered) -> list[Fact]:
    whole = Fact("recording", "complete", "good") if told.complete else Fact("recording", "incomplete", "bad")
    facts = [
        whole,
        Fact("simulated", f"{told.seconds:.4g} s"),
        Fact("samples", f"{told.samples:,}".replace(",", " ")),
    ]
    for form in told.forms[:1]:
        if form.first and form.last:
            facts.append(Fact("revolutions", str(form.rms.size)))
            facts.append(Fact("RMS, first revolution", f"{_number(form.first.numbers['rms'])} µm"))
            facts.append(Fact("RMS, last revolution", f"{_number(form.last.numbers['rms'])} µm"))
    if told.run_id:
        facts.append(Fact("run", printable(told.run_id, 16)))
    return facts


def render(told: Gathered, name: str, command: str, made_of: Budget | None = None) -> str:
    """The page.

    Args:
        told: what was gathered.
        name: of the bag.
        command: that makes the page again.
        made_of: what the form error is made of; None: nobody has asked.
    """
    with mpl.rc_context(figures.STYLE), np.errstate(over="ignore", invalid="ignore"):
        cycles = {f"{topic}: {field}": found for (topic, field), found in told.curves.cycles.items() if found.size}
        forms = [_form(form, cycles, len(told.forms)) for form in told.forms]
        signals, timing = _signals(told), _timing(told)
        if cycles and not any(form.figures for form in forms):
            caption = "The controllers' own measurements, by cycle."
            specs = [charts.convergence(None, cycles)]
            drawn = figures.convergence(None, cycles)
            signals.append(Picture("Convergence", drawn, caption, "docs/learning.md", specs))
    pictures = [*(each for form in forms for each in form.figures), *signals, *([timing] if timing else [])]
    shown = Charts()
    for number, picture in enumerate(pictures):
        picture.places = [f"figure-{number}-{k}" for k in range(len(picture.specs))]
        for place, spec in zip(picture.places, picture.specs, strict=True):
            shown.add(place, {"": spec})
    text: str = page_template(Path(__file__).with_name("report.html.j2")).render(
        title=f"Report of {printable(name, 80)}",
        command=printable(command),
        version=__version__,
        charts=shown,
        judged=judged(told, losses(told), made_of),
        budget_hint=hint(told, made_of),
        facts=_facts(told),
        missing=told.missing,
        budget=_budget(made_of) if made_of else None,
        forms=forms,
        signals=signals,
        timing=timing,
        nodes=_nodes(told),
        states=[printable(state) for state in told.host.states],
        topics=_topics(told),
        events=_events(told),
        versions=_versions(told),
        origins=_origins(told),
        about=_about(told),
        scenario=printable(told.about.get(SCENARIO, ""), _LONGEST_SCENARIO),
    )
    return text


def write_report(bag: str | os.PathLike[str], page: str | os.PathLike[str], *, with_budget: bool = False) -> Gathered:
    """Write the report of a bag; an older one of the same name is replaced once the new one is whole.

    Args:
        bag: the bag.
        page: the HTML file.
        with_budget: tell what the form error is made of, by runs of the bag's scenario.

    Raises:
        InputError: not a bag, or no place for a page; with a budget, a bag without a scenario that can run offline.
        LatheError: the disk does not take it, or a run of the budget failed.

    Example:
        >>> import lathe_rc
        >>> result = lathe_rc.run(lathe_rc.load("piston", ["spindle_encoder.revolutions=2"]), bag="piston_bag")
        >>> report = lathe_rc.write_report("piston_bag", "piston.html")
    """
    bag, page = Path(bag), Path(page)
    if page.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"-o {page}; allowed: a file name that ends in .html")
    check_place("-o", page)
    told = gather(bag)
    found = _budgeted(told) if with_budget else None
    command = shlex.join(["lathe", "report", str(bag), *(["--budget"] if with_budget else []), "-o", str(page)])
    text = render(told, name_of(bag), command, found)
    try:
        with replacing(page) as file:
            file.write(text.encode("utf-8", "replace"))
    except OSError as error:
        raise LatheError(f"{page}: cannot be written ({error.strerror})") from None
    return told
