# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe demo``: a cell of ROS 2 processes, recorded, with a picture of the result."""

from pathlib import Path

import click
from rich.console import Console

from lathe_rc.commands import outcome
from lathe_rc.commands import scenario as options
from lathe_rc.commands.run import run_shown

_DEMOS = {
    "piston": (
        "An oval-barrel piston at 1000 rpm with a 10 % harmonic speed deviation: five ROS 2 processes, one bag.",
        "Oval-barrel piston, 1000 rpm, 10 % speed deviation",
    ),
    "two_channel": (
        "An oval-barrel piston, coarse and piezo channel both self-learning: seven ROS 2 processes, one bag.",
        "Oval-barrel piston, 1000 rpm, self-learning coarse and piezo channel",
    ),
}


@click.command()
@click.argument("name", type=click.Choice(list(_DEMOS)), default="piston")
@click.option("--revolutions", type=click.FloatRange(min=1), default=60.0, show_default=True)
@click.option("--folder", type=click.Path(path_type=Path), default=Path("bags"), show_default=True, help="for results")
def demo(name: str, revolutions: float, folder: Path) -> None:
    """Turn an oval-barrel piston: processes over DDS, learning, everything recorded.

    NAME is piston (one channel, the default) or two_channel (a piezo channel learns what the coarse one leaves).
    """
    number = 1
    while (folder / f"demo-{number}").exists():
        number += 1
    place = folder / f"demo-{number}"
    announcement, title = _DEMOS[name]
    scenario = options.load(name, [f"spindle_encoder.revolutions={revolutions!r}"])
    console = Console()
    console.print(announcement, highlight=False)
    folder.mkdir(parents=True, exist_ok=True)
    result = run_shown(scenario, mode="processes", groups=None, bag=place)
    from lathe_rc.view import figure

    picture = place.with_suffix(".png")
    figure.save(picture, result.recording, result.errors, title)
    console.print(outcome.table(result))
    for fact in outcome.facts(result):
        console.print(fact, highlight=False)
    console.print(f"bag:    {place}\nfigure: {picture}", highlight=False, soft_wrap=True)
