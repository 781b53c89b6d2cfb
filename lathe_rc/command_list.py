# SPDX-License-Identifier: Apache-2.0
"""Names and summaries of the ``lathe`` commands; a command's module is imported on demand."""

from typing import TYPE_CHECKING, cast

from lathe_rc.extras import load

if TYPE_CHECKING:  # the first ./lathe --help runs before any package is installed
    import click

COMMANDS = {
    "bag": "Show, check, copy and recover bags; extract a tachogram.",
    "budget": "Split the form error of a scenario by its causes.",
    "compare": "Write several runs side by side as an HTML page.",
    "container": "Run several nodes in one process.",
    "correct": "Correct the programmed form of the next part.",
    "demo": "Turn a piston with ROS 2 processes and draw it.",
    "design": "Find the learning law of a scenario for a measured drive.",
    "export": "Export a recording as tables, or stages as C libraries or FMUs.",
    "fit": "Fit models to measurements.",
    "loop": "Show block diagram and learning loops, with settings to drag.",
    "measure": "Measure the part turned in a recorded run.",
    "new": "Create a law, drive, stage or study of your own.",
    "node": "Run one node, or list its parameters.",
    "panel": "Show a cell at work in the browser, and command it.",
    "policy": "Write the SROS2 policy of a scenario.",
    "record": "Record any topics into a new bag.",
    "reference": "Print the reference of nodes and topics.",
    "replay": "Publish the messages of a bag again.",
    "report": "Write a recording as an HTML page.",
    "resim": "Re-simulate a recorded cell, optionally with changes.",
    "run": "Run a scenario to its end.",
    "study": "Compute a table or figure of the papers.",
    "sweep": "Compute many variations of a scenario into a table.",
    "tune": "Search for the parameters that best meet given goals.",
    "view": "Show a bag in Rerun.",
}  #: summaries of the commands, by name
_BESIDES = {"container": "node"}  # commands defined in another command's module


def imported(name: str) -> "click.Command":
    """Return a command after importing its module."""
    module = load(f"lathe_rc.commands.{_BESIDES.get(name, name)}")
    return cast("click.Command", getattr(module, name))
