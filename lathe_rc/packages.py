# SPDX-License-Identifier: Apache-2.0
"""Packages of this distribution, with the commands and executables of each; nothing here is imported.

The core, ``lathe_rc``, runs cells, reads and writes bags, and judges and shows a run. The other packages import the
core and never each other; only this table knows all of them. A package that is taken away takes its commands along.
"""

COMMANDS_OF = {
    "lathe_rc": {
        "bag": "Show, check, copy and recover bags; extract a tachogram.",
        "budget": "Split the form error of a scenario by its causes.",
        "compare": "Write several runs side by side as an HTML page.",
        "container": "Run several nodes in one process.",
        "demo": "Turn a piston with ROS 2 processes and draw it.",
        "new": "Create a law, drive, stage or study of your own.",
        "node": "Run one node, or list its parameters.",
        "policy": "Write the SROS2 policy of a scenario.",
        "reference": "Print the reference of nodes and topics.",
        "report": "Write a recording as an HTML page.",
        "run": "Run a scenario to its end.",
        "study": "Compute a table or figure of the papers.",
    },
    "lathe_bagtools": {
        "record": "Record any topics into a new bag.",
        "replay": "Publish the messages of a bag again.",
        "resim": "Re-simulate a recorded cell, optionally with changes.",
    },
    "lathe_commission": {
        "correct": "Correct the programmed form of the next part.",
        "design": "Find the learning law of a scenario for a measured drive.",
        "fit": "Fit models to measurements.",
        "measure": "Measure the part turned in a recorded run.",
    },
    "lathe_explore": {
        "sweep": "Compute many variations of a scenario into a table.",
        "tune": "Search for the parameters that best meet given goals.",
    },
    "lathe_export": {
        "export": "Export a recording as tables, or stages as C libraries or FMUs.",
    },
    "lathe_live": {
        "loop": "Show block diagram and learning loops, with settings to drag.",
        "panel": "Show a cell at work in the browser, and command it.",
        "view": "Show a bag in Rerun.",
    },
}  #: summaries of the commands, by package and name

OURS = frozenset([*COMMANDS_OF, "lathe_papers"])  #: packages of this distribution

COMMANDS = dict(sorted((name, text) for table in COMMANDS_OF.values() for name, text in table.items()))
_BESIDES = {"container": "node"}  # commands defined in another command's module

#: modules of the executables that are no member of a cell
STANDALONE = {
    "container": "lathe_rc.nodes.container",
    "machine_state": "lathe_rc.nodes.machine_state",
    "replayer": "lathe_bagtools.nodes.replayer",
    "rerun_bridge": "lathe_live.nodes.rerun_bridge",
    "topic_recorder": "lathe_bagtools.nodes.topic_recorder",
}


def module_of(command: str) -> str:
    """Return the module of a command, which has an object of the command's name."""
    (package,) = [package for package, table in COMMANDS_OF.items() if command in table]
    return f"{package}.commands.{_BESIDES.get(command, command)}"
