# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe demo``: a recorded cell of ROS 2 processes, with a figure of the result."""

from pathlib import Path
from typing import NamedTuple

import click

from lathe_rc import process_launcher
from lathe_rc.commands import options


class Demo(NamedTuple):
    """Cell of a demonstration.

    Attributes:
        scenario: name of the cell's scenario.
        announcement: text printed before the run.
        title: title of the figure.
        overrides: overrides of the scenario, as for ``--set``.
        peer: overrides that select another law for comparison, which runs offline and is drawn as well.
        peer_name: name of the other law.
    """

    scenario: str
    announcement: str
    title: str
    overrides: tuple[str, ...] = ()
    peer: tuple[str, ...] = ()
    peer_name: str = ""


DEMOS = {
    "piston": Demo(
        "piston",
        "An oval-barrel piston at 1000 rpm with a 10 % harmonic speed deviation: five ROS 2 processes, one bag.",
        "Oval-barrel piston, 1000 rpm, 10 % speed deviation",
    ),
    "two_channel": Demo(
        "two_channel",
        "An oval-barrel piston, coarse and piezo channel both self-learning: seven ROS 2 processes, one bag.",
        "Oval-barrel piston, 1000 rpm, self-learning coarse and piezo channel",
    ),
    "interrupted": Demo(
        "robust_cutting",
        "An oval-barrel piston with a keyway, cut while the speed wanders by 10 %; the force bends the drive. Six "
        "ROS 2 processes, one bag; then the compound law of PMC8878366 on the same cell, offline.",
        "Oval-barrel piston with a keyway, 1000 rpm ±10 %, force on the drive",
        (
            "profile.profile=piston",
            "loaded_drive.cut_gap_start=[2.6]",
            "loaded_drive.cut_gap_width=[0.35]",
        ),
        ("controller.stage=compound_controller",),
        "compound law (PMC8878366)",
    ),
}


@click.command()
@click.argument("name", type=click.Choice(list(DEMOS)), default="piston")
@click.option("--revolutions", type=click.FloatRange(min=1), default=60.0, show_default=True)
@click.option("--folder", type=options.PATH, default=Path("bags"), show_default=True, help="for results")
def demo(name: str, revolutions: float, folder: Path) -> None:
    """Turn an oval-barrel piston in separate processes over DDS, with learning and full recording.

    NAME is piston (one channel, the default), two_channel (a piezo channel learns the residual error of the coarse one)
    or interrupted (a keyway, force on the drive and a varying speed, with the disturbance controller and, for
    comparison, with another law).
    """
    process_launcher.server().preload({})  # the server imports concurrently with this process
    _show(DEMOS[name], revolutions, folder)


def _show(shown: Demo, revolutions: float, folder: Path) -> None:
    from rich.console import RenderableType
    from rich.text import Text

    from lathe_rc import harness
    from lathe_rc.commands import outcome, picture, plot, running, tables
    from lathe_rc.commands import scenario as scenarios

    number = 1
    while (folder / f"demo-{number}").exists():
        number += 1
    place = folder / f"demo-{number}"
    length = f"spindle_encoder.revolutions={revolutions!r}"
    scenario = scenarios.load(shown.scenario, [*shown.overrides, length])
    console = tables.console(soft_wrap=False)
    console.print(shown.announcement)
    folder.mkdir(parents=True, exist_ok=True)
    result = running.watched(scenario, mode="processes", bag=place)
    beside = None
    if shown.peer:
        peer = harness.run(scenarios.load(shown.scenario, [*shown.overrides, *shown.peer, length]))
        beside = (shown.peer_name, peer.recording)
    drawn = place.with_suffix(".png")
    picture.save(result.recording.plot(shown.title, beside), drawn)
    text: list[RenderableType] = [outcome.table(result), *plot.shown(result, console)]
    if beside:
        text += [f"{shown.peer_name}: {', '.join(peer.errors.told()[1:])}"]
    text += map(Text, outcome.facts(result))
    ends = {"bag": place, "figure": drawn, "page": f"lathe report {place}", "view": f"lathe view {place}"}
    text += (f"{name + ':':8}{end}" for name, end in ends.items())
    tables.show({}, text, as_json=False)
