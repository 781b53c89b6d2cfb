# SPDX-License-Identifier: Apache-2.0
"""Panel of a cell: a page that shows it at work and carries out commands."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from lathe_live.page_server import Answer, Page, Site
from lathe_live.panel_causes import Causes
from lathe_live.panel_player import Player
from lathe_live.panel_run import Driver, LiveCell
from lathe_live.panel_view import Have, View, has_memory, news
from lathe_rc import messages
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.drawing.pages import own_file
from lathe_rc.errors import InputError
from lathe_rc.messages import full
from lathe_rc.safety import faults

_HERE = Path(__file__).parent

_PATIENCE = 1.0  # [s] until a page without news gets an answer
_SHOWN = {"wrong": {"scale": 0.9}}  # values offered in place of the defaults, which change nothing
_FILES = ("save", "load")  # events that need a file, which the page does not name


def page() -> Page:
    """Return the page of the panel."""
    scripts = [
        own_file(f"{name}.js", _HERE)
        for name in ("panel", "panel_drawings", "panel_timeline", "panel_causes", "panel_commands")
    ]
    return Page("panel", own_file("panel.html", _HERE), [own_file("panel.css", _HERE)], scripts)


def with_loops(panel: Site, loop: Site) -> Site:
    """Return a panel with the page of the loops of its scenario as a tab."""
    return Site({**panel.pages, "loop": loop.pages[""]}, {**loop.answers, **panel.answers})


def site(driver: Driver, cell: LiveCell) -> Site:
    """Return the panel of an offline cell."""
    return Site({"": page()}, {**_watching(cell.view), **_playing(driver), **_commands(driver, cell)})


def player_site(driver: Driver, player: Player) -> Site:
    """Return the panel of a bag."""

    def start(_: Mapping[str, Any]) -> None:
        if player.reached >= player.samples:
            player.seek(player.first)
        driver.start()

    def seek(question: Mapping[str, Any]) -> None:
        player.seek(int(_number(question, "sample")))
        driver.again()

    about = {**player.view.outlook, "can": ["run", "seek"], "nodes": [], "faults": {}, "parameters": []}
    answers = {"about": lambda _: about, "seek": _called(driver, seek), "start": _called(driver, start)}
    return Site({"": page()}, {**_watching(player.view), **_playing(driver), **answers})


class Attached(Protocol):
    """Commands to a cell that runs elsewhere.

    Attributes:
        cannot: why a button of the page is of no use, by its id.
    """

    cannot: Mapping[str, str]

    def act(self, node: str, action: str) -> str:
        """Ask a node for an event, and return it as in a scenario."""

    def hold(self, *, held: bool) -> None:
        """Pause the run, or let it go on."""

    def pace(self, factor: float) -> None:
        """Set the simulated seconds in a second; 0: as fast as possible."""

    def record(self, bag: str) -> None:
        """Begin to record into a bag; an empty text ends the recording."""


def attached_site(view: View, cell: Cell, commands: Attached) -> Site:
    """Return the panel of a cell that runs elsewhere.

    Args:
        view: its view.
        cell: the cell of its scenario, for the choice of commands.
        commands: commands to its nodes.
    """
    nodes = [_node(stage) for stage in cell.stages.values()]
    can = {"can": ["run", "command", "record"], "cannot": commands.cannot}
    about = {**view.outlook, "revolutions": 0.0, **can, "nodes": nodes, "faults": _faults(), "parameters": []}
    answers: dict[str, Answer] = {
        "about": lambda _: about,
        "act": lambda question: {"text": commands.act(_text(question, "node"), _text(question, "action"))},
        "start": _done(lambda _: commands.hold(held=False)),
        "pause": _done(lambda _: commands.hold(held=True)),
        "pace": _done(lambda question: commands.pace(_number(question, "factor"))),
        "record": _done(lambda question: commands.record(_text(question, "bag").strip())),
    }
    return Site({"": page()}, {**_watching(view), **answers})


def _watching(view: View) -> dict[str, Answer]:
    """Return the answers that every run has: news, the timeline, and an extreme of it."""

    def timeline(question: Mapping[str, Any]) -> object:
        first, last = (None if question.get(name) is None else _number(question, name) for name in ("first", "last"))
        return view.timeline.shown(first, last, int(_number(question, "cells")))

    def extreme(question: Mapping[str, Any]) -> object:
        return view.timeline.extreme(_number(question, "first"), _number(question, "last"), _text(question, "lane"))

    frame = lambda question: news(view, Have.of(question), _PATIENCE)  # noqa: E731
    return {"frame": frame, "timeline": timeline, "extreme": extreme}


def _done(command: Callable[[Mapping[str, Any]], object]) -> Answer:
    """Return an answer that carries out a command, which may return nothing."""
    return lambda question: command(question) or {}


def _called(driver: Driver, command: Callable[[Mapping[str, Any]], object]) -> Answer:
    """Return an answer that carries out a command between two blocks."""
    return _done(lambda question: driver.call(lambda: command(question)))


def _playing(driver: Driver) -> dict[str, Answer]:
    """Return the answers of a run with a pace."""
    return {
        "start": _called(driver, lambda _: driver.start()),
        "pause": _called(driver, lambda _: driver.pause()),
        "step": _called(driver, lambda _: driver.step()),
        "pace": _called(driver, lambda question: driver.pace(_number(question, "factor"))),
    }


def _commands(driver: Driver, cell: LiveCell) -> dict[str, Answer]:
    """Return the answers that change the cell."""

    def act(question: Mapping[str, Any]) -> object:
        return {"text": cell.act(_text(question, "node"), _text(question, "action"))}

    def change(question: Mapping[str, Any]) -> None:
        given = question.get("values")
        if not isinstance(given, dict):
            raise InputError("values of parameters are missing; allowed: an object of texts")
        values = {str(name): ros_yaml.parse_value(str(text), str(name)) for name, text in given.items()}
        cell.change(values, here=question.get("here") is True)
        driver.again()

    def record(question: Mapping[str, Any]) -> None:
        if not (bag := _text(question, "bag").strip()) and not cell.recording:
            raise InputError("bag = ''; allowed: a name, for the folder of the bag")
        cell.record(bag)

    commands = {"about": lambda _: about(cell), "act": act, "change": change, "record": record}
    causes = Causes(lambda: driver.call(cell.so_far))
    return {"causes": causes.budget, **{name: _called(driver, command) for name, command in commands.items()}}


def _text(question: Mapping[str, Any], name: str) -> str:
    value = question.get(name)
    if not isinstance(value, str):
        raise InputError(f"{name} = {json.dumps(value):.80}; allowed: a text")
    return value


def _number(question: Mapping[str, Any], name: str) -> float:
    value = question.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= 1e300:
        raise InputError(f"{name} = {json.dumps(value):.80}; allowed: a number")
    return float(value)


def about(cell: LiveCell) -> dict[str, Any]:
    """Return what does not change while a cell runs: its nodes, their events, knobs and faults, its parameters."""
    return {
        **cell.view.outlook,
        "can": ["run", "command", "change", "record", "causes"],
        "nodes": [_node(stage) for stage in cell.cell.stages.values()],
        "faults": _faults(),
        "parameters": [f"{node}.{name}" for node, table in cell.scenario.nodes.items() for name in table.rows()],
    }


def _faults() -> dict[str, Any]:
    """Return the kinds of faults with the values that they need."""
    return {
        name: {
            "doc": kind.doc,
            "values": {key: value.default for key, value in kind.values.items()} | _SHOWN.get(name, {}),
        }
        for name, kind in faults.KINDS.items()
    }


def _node(stage: Stage) -> dict[str, Any]:
    rows = type(stage.shared).rows()
    return {
        "name": stage.name,
        "actions": [action for action in stage.actions if action not in _FILES],
        "knobs": [
            {"name": name, "value": getattr(stage.parameters, name), "unit": rows[name].unit, "doc": rows[name].doc}
            for name in stage.tunable
        ],
        "targets": stage.fault_targets,
        "memory": has_memory(stage),
        "learning": [full(topic) for topic, kind in stage.sparse_topics.items() if kind == messages.LEARNING],
    }
