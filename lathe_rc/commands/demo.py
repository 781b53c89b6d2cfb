# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe demo``: a cell of ROS 2 processes, recorded, with a picture of the result."""

from pathlib import Path

import click

from lathe_rc import process_launcher
from lathe_rc.commands.demos import DEMOS


@click.command()
@click.argument("name", type=click.Choice(list(DEMOS)), default="piston")
@click.option("--revolutions", type=click.FloatRange(min=1), default=60.0, show_default=True)
@click.option("--folder", type=click.Path(path_type=Path), default=Path("bags"), show_default=True, help="for results")
def demo(name: str, revolutions: float, folder: Path) -> None:
    """Turn an oval-barrel piston: processes over DDS, learning, everything recorded.

    NAME is piston (one channel, the default), two_channel (a piezo channel learns what the coarse one leaves) or
    interrupted (a keyway, force on the drive and a wandering speed, by the disturbance controller and by its peer).
    """
    process_launcher.server().preload({})  # it imports while this process does
    from lathe_rc.commands import running

    running.demo(DEMOS[name], revolutions, folder)
