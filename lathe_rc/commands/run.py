# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe run``: run a scenario to its end."""

from typing import TYPE_CHECKING, Any

import click

from lathe_rc import allowed_code, process_launcher
from lathe_rc.commands import options

if TYPE_CHECKING:
    from lathe_rc.harness import Mode
    from lathe_rc.process_launcher import Start


@click.command()
@options.scenario
@click.option("--mode", type=click.Choice(["offline", "composed", "processes"]), default="offline", show_default=True)
@options.groups
@click.option("--revolutions", type=options.POSITIVE, help="length of the run")
@click.option("--speed-factor", type=click.FloatRange(min=0), help="pace against real time; 0: as fast as possible")
@click.option("--strict", is_flag=True, help="exit with 4 when the members are too slow for the pace")
@click.option("--bag", type=options.PATH, help="folder to record to; must not exist")
@click.option(
    "--checkpoint",
    "checkpoints",
    type=(str, options.PATH),
    multiple=True,
    metavar="WHEN FILE",
    help="write the state of the cell at revolution:R, second:T or sample:N; repeatable",
)
@options.start_from
@click.option("--profile", type=options.PATH, help="CSV file to write the last revolution's profile to")
@click.option("--figure", type=options.PATH, help="PNG to draw the form and its error to")
@options.overrides
@click.option("--domain", type=click.IntRange(0, 232), help="ROS domain, for others to listen; default: a free one")
@click.option("--namespace", help="of the nodes, for two cells in one domain; default: /")
@options.start
@click.option("--require-tolerance", is_flag=True, help="exit with 1 unless the run ends within each tolerance")
@click.option("--budget", is_flag=True, help="tell what the form error is made of as well, by some ten further runs")
@options.allow_code
@options.as_json
def run(mode: "Mode", start: "Start | None", **asked: Any) -> None:
    """Run a SCENARIO, a ROS 2 parameter file, to its end."""
    allowed_code.allow_own_code()
    if mode != "offline" and start != "spawn":
        process_launcher.server().preload({})  # the server imports concurrently with this process
    from lathe_rc.commands import running

    running.run(mode=mode, start=start, **asked)
