# SPDX-License-Identifier: Apache-2.0
"""Names and summaries of the ``lathe`` commands; a command's module is imported on demand."""

from typing import TYPE_CHECKING, cast

from lathe_rc.extras import load

if TYPE_CHECKING:  # the first ./lathe --help runs before any package is installed
    import click

COMMANDS = {
    "bag": "Ask bags what is in them; check and recover them; take a tachogram out.",
    "budget": "Tell what the form error of a scenario is made of.",
    "completion": "Make the shell complete the command line.",
    "container": "Run several nodes in one process.",
    "demo": "Turn a piston with ROS 2 processes and draw it.",
    "export": "Export a recording as CSV, Parquet or NPZ.",
    "fit": "Fit models to measurements.",
    "measure": "Measure the part that a recorded run has turned.",
    "new": "Begin a law, drive, stage or study of your own.",
    "node": "Run one node, or list its parameters.",
    "policy": "Make the SROS2 policy of a scenario.",
    "record": "Record any topics into a new bag.",
    "reference": "Print the reference of nodes and topics.",
    "replay": "Send the messages of a bag again.",
    "report": "Write a recording as one HTML page.",
    "resim": "Run a recorded cell again, also with changes.",
    "run": "Run a scenario to its end.",
    "study": "Compute a table or figure of the papers.",
    "sweep": "Compute many variations of a scenario into a table.",
    "tune": "Search the parameters of a scenario that meet goals best.",
    "view": "Show a bag in Rerun.",
}  #: summaries of the commands, by name
_BESIDES = {"container": "node"}  # commands defined in another command's module


def imported(name: str) -> "click.Command":
    """Return a command after importing its module."""
    module = load(f"lathe_rc.commands.{_BESIDES.get(name, name)}")
    return cast("click.Command", getattr(module, name))
