# SPDX-License-Identifier: Apache-2.0
"""A bag as one HTML page that needs nothing else.

Texts of a bag are foreign: they are escaped by the template, cut to a length, and shown without characters that do not
print.
"""

import json
import shlex
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

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
from lathe_rc.view import report_figures as figures
from lathe_rc.view.charts import Charts, Spec, page_template
from lathe_rc.view.report_form import CUTOFF, Form
from lathe_rc.view.report_gather import Gathered, gather
from lathe_rc.view.report_series import Envelope
from lathe_rc.view.report_verdict import hint, judged

_LONGEST_SCENARIO = 200_000  # characters
_LONGEST_TEXT = 300
_MOST_ROWS = 200
_RPM = 60.0 / (2.0 * np.pi)
_METROLOGY, _CELL, _BAGS = "docs/metrology.md", "docs/cell.md", "docs/bags.md"


@dataclass(frozen=True)
class Picture:
    """A figure with what it shows and where its formula is; several specifications lie side by side."""

    name: str
    specs: Sequence[Spec]
    caption: str
    page: str
    places: list[str] = field(default_factory=list)  # elements of the page, one a specification


@dataclass(frozen=True)
class Grid:
    """A table; ``texts`` are the columns that are no numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str
    page: str
    texts: Sequence[str]


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


def _grid(
    columns: Sequence[str],
    rows: Iterable[Sequence[str | float]],
    caption: str,
    page: str,
    texts: Sequence[str] = (),
    count: int = 0,
) -> Grid | None:
    """A table of the first rows, and how many more there are of ``count``; None without rows."""
    cells = [
        [_number(cell) if isinstance(cell, float) else printable(str(cell)) for cell in row]
        for row in islice(rows, _MOST_ROWS)
    ]
    if count > len(cells):
        cells.append([f"… and {count - len(cells)} more"])
    return Grid(columns, cells, caption, page, texts) if cells else None


# --- the form


def _metrics(form: Form) -> Grid | None:
    rows = []
    for name, revolution in figures.shown_revolutions(form):
        told = revolution.numbers
        waves = f"{told['largest_upr']['upr']}: {_number(told['largest_upr']['amplitude'])}"
        values = (float(told[key]) for key in ("rms", "max", "peak_to_valley", "ront", "ronq"))
        rows.append([told["revolution"], name, *values, *map(float, told["centre"]), waves, float(told["ra"])])
    return _grid(
        ("revolution", "", "RMS", "max", "P-V", "RONt", "RONq", "centre x", "centre y", "largest UPR", "Ra"),
        rows,
        "In µm. RMS, max and P-V of the form error; RONt and RONq from the least-squares circle, with centre x, y; "
        f"filters at {CUTOFF:.0f} UPR (undulations per revolution). Best is the smallest RMS of "
        f"{form.rms.size} revolutions.",
        _METROLOGY,
        ("",),
    )


def _form(form: Form, cycles: Mapping[str, Envelope], maps: int) -> FormSection:
    """The figures of a tool; ``maps``: of the page."""
    tool, refused = printable(form.tool), printable(form.refused)
    if form.first is None:
        return FormSection(tool, refused or "the bag holds no complete revolution", None, ())
    grouped = f" Each line is the mean of {form.map.group} revolutions." if form.map.group > 1 else ""
    pictures = [
        Picture(
            "Error map",
            [figures.form_map(form, maps)],
            "Radius of the part less desired radius over spindle angle and revolution; red: material left. The colours "
            "are linear around zero and logarithmic beyond the largest of the quietest quarter of revolutions."
            f"{grouped}",
            _METROLOGY,
        ),
        Picture(
            "First and last revolution",
            figures.polar(form),
            "Radius deviation around the part, each in its own scale; dashed: the desired form.",
            _METROLOGY,
        ),
        Picture(
            "Error spectrum",
            [figures.spectrum(form)],
            "Amplitude A_n of r = Σ A_n·sin(nφ + ψ_n) by undulations per revolution n of the first, best and last "
            "revolution.",
            _METROLOGY,
        ),
        Picture(
            "Convergence",
            [figures.convergence(form, cycles)],
            "RMS over the angle and largest magnitude of the true form error by revolution; dots: what each controller "
            "measured in its own cycles, which begin and end elsewhere.",
            f"{_METROLOGY}, docs/learning.md",
        ),
    ]
    if isinstance(form.surface, Lay):
        told = along_in_words(form.surface)
        caption = f"{told[0].upper()}{told[1:]}. What nose and feed leave, by the tool's nose_radius."
        pictures.append(Picture("Surface along the part", figures.along(form.surface), caption, _METROLOGY))
    elif form.surface:
        refused = f"{refused} {form.surface}".strip()
    return FormSection(tool, refused, _metrics(form), pictures)


# --- signals and the host


def _signals(told: Gathered) -> Iterator[Picture]:
    for own, name, unit, scale, page in (
        ("speed_true", "Spindle speed", "speed [1/min]", _RPM, "docs/signals.md"),
        ("force", "Cutting force", "main cutting force [N]", 1.0, "docs/cutting.md"),
        ("wear", "Wear", "wear VB [µm]", 1e6, "docs/cutting.md"),
    ):
        curves = {topic: series for (topic, each), series in told.curves.signals.items() if each == own and series.size}
        if curves:
            low, high = (np.array([series.extremes for series in curves.values()]) * scale).T
            caption = f"True values, {_number(float(low.min()))} to {_number(float(high.max()))}."
            group = max(series.group for series in curves.values())
            if group > 1:
                caption += f" The band spans the extremes of {group} samples each, the line is its middle."
            yield Picture(name, [figures.against_time(told, curves, unit, scale)], caption, page)


def _timing(told: Gathered) -> Picture | None:
    if not told.host.pace.size:
        return None
    return Picture(
        "Pace, lateness and latency",
        figures.timing(told.host, told.step_ns * 1e-9),
        f"Pace: simulated time by wall time, in {told.host.pace.size} intervals between reports of the time master on "
        "/diagnostics. Lateness: from the moment at which a block was due to that at which the time master let it go; "
        "only where the speed is given. Latency: from there until the time master had heard that every member had "
        "completed the block; members report several blocks at a time.",
        _CELL,
    )


def _nodes(told: Gathered) -> Grid | None:
    levels = ("ok", "warning", "error", "stale")
    rows = (
        [
            name,
            node.reports,
            levels[node.level] if node.level < len(levels) else "?",
            *(printable(node.values.get(key, "–"), 20) for key in ("blocks", "lost blocks")),
            node.message,
        ]
        for name, node in told.host.nodes.items()
    )
    caption = "From /diagnostics: the worst level of all reports, the rest as last reported."
    columns = ("node", "reports", "worst", "blocks", "lost", "message")
    return _grid(columns, rows, caption, _CELL, ("node", "worst", "message"))


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
    if told.unjudged:
        found.append(f"no tolerance is known: {told.unjudged}")
    if told.about.get(RECOVERED):
        found.append(f"the bag was cut off and has been recovered: {told.about[RECOVERED]}")
    if host.unreadable:
        found.append(f"{host.unreadable} messages of host topics cannot be decoded")
    if host.left_out:
        found.append(f"{host.left_out} lines of host topics beyond those shown")
    return [printable(text) for text in found]


# --- the bag


def _topics(told: Gathered) -> Grid | None:
    dense = messages.block_types()
    rows = (
        [
            topic,
            tally.type.rpartition("/")[2],
            tally.count,
            told.samples if tally.type in dense else "",
            tally.rate,
            *(
                f"{(ns - messages.START_NS) * 1e-9:.4f}" if tally.count else "–"
                for ns in (tally.first_ns, tally.last_ns)
            ),
            f"{tally.size / 1e3:.0f}",
        ]
        for topic, tally in told.topics.items()
    )
    columns = ("topic", "type", "messages", "samples", "rate [1/s]", "from [s]", "to [s]", "kB")
    caption = (
        "Counted while reading. Rate: messages by simulated time between the first and the last; times are log times "
        "since sample 0."
    )
    return _grid(columns, rows, caption, _BAGS, ("topic", "type"), len(told.topics))


def _events(told: Gathered) -> Grid | None:
    rows = ([each.topic, each.sample, each.sample * told.step_ns * 1e-9, each.text] for each in told.curves.events)
    columns = ("topic", "sample", "time [s]", "action")
    return _grid(columns, rows, "Time since sample 0.", _CELL, ("topic", "action"), told.curves.event_count)


def _versions(told: Gathered) -> Grid | None:
    try:
        given = json.loads(told.about.get(VERSIONS, ""))
    except (ValueError, RecursionError):
        return None
    columns = ("made with", "version")
    rows = [(name, str(version)) for name, version in given.items()] if isinstance(given, dict) else []
    return _grid(columns, rows, "", _BAGS, columns, len(rows))


def _origins(told: Gathered) -> Grid | None:
    found = origins(told.about)
    rows = ([origin.name, origin.package or "–", ", ".join(origin.used), origin.source] for origin in found)
    columns = ("class of others", "of", "used by", "source")
    return _grid(columns, rows, "Source: its SHA-256.", "docs/parts.md", columns, len(found))


def _about(told: Gathered) -> Grid | None:
    rows = [
        (key, f"{len(text)} characters of base64" if key.startswith(FILE) else text)
        for key, text in sorted(told.about.items())
        if key not in (SCENARIO, VERSIONS, ORIGINS)
    ]
    return _grid(("key", "text"), rows, "Further metadata of the bag.", _BAGS, ("key", "text"), len(rows))


def _budget(found: Budget) -> Grid | None:
    rows = [[part.name, part.percent(), part.rms * 1e6, part.largest * 1e6] for part in found.rows]
    rows.append(["form error", "100.0", found.rms * 1e6, found.largest * 1e6])
    caption = (
        f"Form error of the last {found.revolutions} revolutions, from runs of the bag's scenario offline with causes "
        "switched off: share in its power, and size of each part by itself. Causes, rest and interactions add up; "
        f"pairs of causes are parts of the interactions, those below {TOLD:.0%} are left out."
    )
    caption += "".join(f" Not switched off: {name}: {printable(why)}." for name, why in found.left_out.items())
    return _grid(("cause", "share [%]", "RMS [µm]", "max [µm]"), rows, caption, _METROLOGY, ("cause",))


def _facts(told: Gathered) -> Iterator[tuple[str, str, str]]:
    """The figures of the run at the top: name, value and mood."""
    yield ("recording", "complete", "good") if told.complete else ("recording", "incomplete", "bad")
    yield "simulated", f"{told.seconds:.4g} s", ""
    yield "samples", f"{told.samples:,}".replace(",", " "), ""
    for form in told.forms[:1]:
        if form.first and form.last:
            yield "revolutions", str(form.rms.size), ""
            yield "RMS, first revolution", f"{_number(form.first.numbers['rms'])} µm", ""
            yield "RMS, last revolution", f"{_number(form.last.numbers['rms'])} µm", ""
    if told.run_id:
        yield "run", printable(told.run_id, 16), ""


def render(told: Gathered, name: str, command: str, made_of: Budget | None = None) -> str:
    """The page.

    Args:
        told: what was gathered.
        name: of the bag.
        command: that makes the page again.
        made_of: what the form error is made of; None: nobody has asked.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        cycles = {f"{topic}: {own}": found for (topic, own), found in told.curves.cycles.items() if found.size}
        forms = [_form(form, cycles, len(told.forms)) for form in told.forms]
        signals, timing = list(_signals(told)), _timing(told)
        if cycles and not any(form.figures for form in forms):
            caption = "The controllers' own measurements, by cycle."
            signals.append(Picture("Convergence", [figures.convergence(None, cycles)], caption, "docs/learning.md"))
    shown = Charts()
    pictures = [*(each for form in forms for each in form.figures), *signals, *([timing] if timing else [])]
    for number, picture in enumerate(pictures):
        for k, spec in enumerate(picture.specs):
            picture.places.append(f"figure-{number}-{k}")
            shown.add(picture.places[-1], {"": spec})
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


def write(bag: Path, page: Path, *, with_budget: bool = False) -> Gathered:
    """Write the report of a bag; an older one of the same name is replaced once the new one is whole.

    Args:
        bag: the bag.
        page: the HTML file.
        with_budget: tell what the form error is made of, by runs of the bag's scenario.

    Raises:
        InputError: not a bag, or no place for a page; with a budget, a bag without a scenario that can run offline.
        LatheError: the disk does not take it, or a run of the budget failed.
    """
    if page.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"-o {page}; allowed: a file name that ends in .html")
    check_place("-o", page)
    told = gather(bag)
    made_of = None
    if with_budget:
        with tempfile.TemporaryDirectory(prefix="lathe-report-") as folder:
            made_of = budget(scenario_of(told.about, Path(folder)))
    command = shlex.join(["lathe", "report", str(bag), *(["--budget"] if with_budget else []), "-o", str(page)])
    text = render(told, name_of(bag), command, made_of)
    try:
        with replacing(page) as file:
            file.write(text.encode("utf-8", "replace"))
    except OSError as error:
        raise LatheError(f"{page}: cannot be written ({error.strerror})") from None
    return told
