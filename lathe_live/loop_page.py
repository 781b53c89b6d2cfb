# SPDX-License-Identifier: Apache-2.0
"""Page of a scenario's loops: block diagram, curves, margins and form error, with settings that can be dragged."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from threading import Lock
from typing import Any

from lathe_live import block_diagram, loop_figures
from lathe_live.page_server import Page, Site
from lathe_live.varied_loop import Along, LoopState, Setting, VariedLoop, drive_curves
from lathe_rc import __version__, files
from lathe_rc.analysis.tolerance import LAST, judge
from lathe_rc.cell.parameters import judged
from lathe_rc.drawing.charts import Charts, Spec, page_template
from lathe_rc.drawing.pages import own_file
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.judge import part
from lathe_rc.names import instead
from lathe_rc.signals.form_errors import FormErrors
from lathe_rc.view import report_loop

Row = tuple[str, str, str]  # name, value, value with all digits
_HERE = Path(__file__).parent


class LoopPage:
    """Page of the loops of a scenario, as a file or as a site.

    Args:
        loop: loops of the scenario.
        place: file for the scenario with the values of the page.
    """

    def __init__(self, loop: VariedLoop, place: Path) -> None:
        self._loop, self._place, self._lock = loop, place, Lock()
        self._strips: dict[str, tuple[dict[str, float], Along]] = {}  # newest of each setting, with the others' values
        self._settings = {each.target: each for each in loop.settings()}
        self._charts = Charts()
        self._state = loop.state({})
        self._places = {name: self._charts.place(specs) for name, specs in self._figures().items()}

    def _figures(self) -> dict[str, list[Spec]]:
        """Return the figures of the scenario by what they show: loops and drives."""
        found, drives = _loops(self._state), drive_curves(self._loop.cell)
        for name in dict.fromkeys(each.node for each in drives):
            found[f"bode {name}"] = loop_figures.bode([each for each in drives if each.node == name])
        return found

    # ---- answers to the page ------------------------------------------------------------------------

    def _values(self, question: Mapping[str, Any]) -> dict[str, float]:
        """Return the values that a page asks for.

        Raises:
            InputError: there is no such setting, or a value is no number.
        """
        given = question.get("values", {})
        if not isinstance(given, dict):
            raise InputError(f"values = {shown(given)}; allowed: an object of numbers")
        for target, value in given.items():
            self._setting(target)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"{target} = {shown(value)}; allowed: a number")
        return {target: float(value) for target, value in given.items()}

    def _setting(self, target: object) -> Setting:
        if target not in self._settings:
            raise InputError(f"{shown(target)}: no such setting; {instead(str(target), self._settings)}")
        return self._settings[str(target)]

    def state(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Return refusal, margins and figures for the ``values`` of a question."""
        values = self._values(question)
        with self._lock:
            state = self._loop.state(values)
        figures = {
            place: spec
            for name, specs in _loops(state).items()
            for place, spec in zip(self._places.get(name, []), specs, strict=False)
        }
        return {"refused": state.refused, "answers": _margins(state), "figures": figures}

    def errors(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Return the form error of a run with the ``values`` of a question."""
        values = self._values(question)
        with self._lock:
            return {"answers": _run(self._loop, values)}

    def along(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Return the margins along the range of a ``setting`` as a picture, for the ``values`` of the others."""
        values, setting = self._values(question), self._setting(question.get("setting"))
        value = values.pop(setting.target, setting.value)
        with self._lock:
            before, found = self._strips.get(setting.target, (None, None))
            if found is None or before != values:
                found = self._loop.along(values, setting)
                self._strips[setting.target] = values, found
        return {"strip": loop_figures.strip(found, value)}

    def write(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Write the scenario with the ``values`` of a question."""
        varied = self._loop.scenario.varied(self._values(question))
        files.write(self._place, varied.to_yaml(given=True))
        return {"written": f"written: {self._place}; lathe run {self._place}"}

    # ---- pages --------------------------------------------------------------------------------------

    def site(self) -> Site:
        """Return the page whose settings can be dragged."""
        scripts = [*self._charts.scripts, own_file("loop.js", _HERE)]
        styles = [own_file("report.css"), *(own_file(name, _HERE) for name in ("loop.css", "diagram.css"))]
        styles.append("figure .chart { display: block; }")  # there are no pictures for printing
        body = page_template(_HERE / "loop_live.html.j2").render(**self._content(live=True))
        page = Page(f"Loop of {self._loop.scenario.name}", body, styles, scripts)
        answers = {"state": self.state, "errors": self.errors, "along": self.along, "write": self.write}
        return Site({"": page}, answers)

    def document(self, command: str) -> str:
        """Return the page as a file, with the values of the scenario; ``command`` reproduces it."""
        template = page_template(_HERE / "loop.html.j2")
        return template.render(**self._content(live=False), version=__version__, command=command)

    def _content(self, *, live: bool) -> dict[str, Any]:
        loop, state, places = self._loop, self._state, self._places
        answers = {"margins": _margins(state), "errors": [] if live else _run(loop, {})}
        note = "" if live else f"With the values of the scenario; lathe loop {loop.scenario.name} lets them be dragged."
        settings = [
            {
                **asdict(each),
                "id": f"setting-{number}",
                "strip": loop_figures.strip(loop.along({}, each), each.value) if not live else "",
            }
            for number, each in enumerate(self._settings.values())
        ]
        names = [stage.name for stage in loop.learners]
        return {
            "title": f"Loop of {loop.scenario.name}",
            "command_note": note,
            "charts": self._charts,
            "live": live,
            "diagram": block_diagram.block_diagram(loop.cell),
            "settings": settings,
            "answers": answers,
            "refusal": state.refused,
            "place": self._place,
            "controllers": [
                {"name": name, "loop": places.get(f"loop {name}"), "bode": places.get(f"bode {name}")} for name in names
            ],
        }


def _loops(state: LoopState) -> dict[str, list[Spec]]:
    return {f"loop {curve.node}": report_loop.loop(curve) for curve in state.curves}


def _margins(state: LoopState) -> list[Row]:
    """Return the margins in the words and digits of ``lathe run``."""
    margins = [
        (
            f"stability margin, {name}",
            "not known" if margin is None else f"{margin:.4g}",
            repr(margin and float(margin)),
        )
        for name, margin in state.margins.items()
    ]
    drives = [
        (f"drive margin, {name}", str(margin), repr(float(margin.error)))
        for name, margin in state.drive_margins.items()
    ]
    return [*margins, *drives]


def _run(loop: VariedLoop, values: Mapping[str, float]) -> list[Row]:
    """Return the form error of a run, or why there is none."""
    try:
        errors = loop.form_errors(values)
    except LatheError as error:
        return [("form error", f"no run: {error}", "")]
    return _errors(loop, errors) if errors.rms.size else []


def _errors(loop: VariedLoop, errors: FormErrors) -> list[Row]:
    count = min(LAST, errors.rms.size)
    over = f"in the last {count} of {errors.rms.size} revolutions" if count > 1 else "in one revolution"
    largest, rms = float(errors.largest[-count:].max()), float(errors.rms[-1])
    found = [
        (f"form error, largest {over}", f"{largest * 1e6:.4g} µm", repr(largest)),
        ("form error, RMS of the last revolution", f"{rms * 1e6:.4g} µm", repr(rms)),
    ]
    declared = judged(loop.scenario.nodes)
    if part.zones(declared):
        return [*found, ("verdict", "not here, since the tolerance differs by zone: lathe run tells it", "")]
    allowed = next(iter(part.tolerances(declared).values()), 0.0)
    return found + ([("verdict", judge(errors.largest, allowed).told(), "")] if allowed else [])
