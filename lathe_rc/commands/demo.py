# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe demo``: a cell of ROS 2 processes, recorded, with a picture of the result."""

from pathlib import Path

import click

from lathe_rc import starting

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
    starting.server().preload({})  # it imports while this process does
    from lathe_rc.commands import running

    running.demo(name, *_DEMOS[name], revolutions, folder)
