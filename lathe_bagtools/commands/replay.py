# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe replay``: publish the messages of a bag again."""

import sys
from pathlib import Path
from typing import Any

import click

from lathe_rc.commands import options


@click.command()
@options.bag
@click.option("--rate", type=click.FloatRange(min=0), default=1.0, show_default=True, help="0: as fast as it goes")
@click.option("--loop", is_flag=True, help="begin again at the end")
@click.option("--start", type=click.FloatRange(min=0), default=0.0, help="[s] from the bag's first message on")
@click.option("--end", type=click.FloatRange(min=0), default=0.0, help="[s] from its first message on; 0: to its end")
@options.topics("all")
@click.option("--remap", multiple=True, metavar="FROM:=TO", help="send a topic under another name; repeatable")
@click.option("--delay", type=click.FloatRange(min=0), default=0.0, help="[s] before the first message, in each round")
@click.option("--start-paused", is_flag=True, help="wait for the service ~/resume or a key")
@click.option("--qos-profile-overrides-path", "qos_overrides", type=options.PATH, help="YAML file of policies by topic")
@click.option("--wait", type=click.IntRange(min=0), default=0, metavar="N", help="begin when each topic has N readers")
@click.option("--as-cell", is_flag=True, help="as the nodes that made it; begins when a recorder node is ready")
@options.allow_code
def replay(
    bag: Path, topics: tuple[str, ...], remap: tuple[str, ...], qos_overrides: Path | None, **values: Any
) -> None:
    """Publish the messages of a BAG again, with /clock and the services of rosbag2's player.

    Keys in a terminal: space pauses and resumes, the right arrow sends the next message of a paused replay, the upper
    and lower arrows change the rate by a tenth.
    """
    from lathe_bagtools.nodes import replayer

    values |= {"bag": str(bag), "topics": list(topics), "remap": list(remap)}
    if qos_overrides is not None:
        values["qos_overrides"] = str(qos_overrides)
    sys.exit(replayer.run(values, ["--ros-args"]))
