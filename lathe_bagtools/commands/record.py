# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe record``: record any topics into a bag."""

import sys
from pathlib import Path
from typing import Any

import click

from lathe_rc.commands import options


@click.command()
@options.bag
@options.topics("all but those of ROS itself")
@click.option("--all", is_flag=True, help="hidden topics, /rosout and /parameter_events as well")
@click.option("--sim-time", is_flag=True, help="log times from /clock; default: the wall time of publication")
@click.option("--once", is_flag=True, help="end when all publishers are gone")
@click.option("--hold", type=click.FloatRange(min=0, min_open=True, max=60), help="[s] that messages wait for others")
def record(bag: Path, topics: tuple[str, ...], hold: float | None, **values: Any) -> None:
    """Record any topics into a new BAG, in the order of publication; Ctrl-C ends the recording.

    Exit code 3: messages are missing.
    """
    from lathe_bagtools.nodes import topic_recorder

    values |= {"bag": str(bag), "topics": list(topics)}
    if hold is not None:
        values["hold"] = hold
    sys.exit(topic_recorder.run(values, ["--ros-args"]))
