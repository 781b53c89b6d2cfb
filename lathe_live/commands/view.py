# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe view``: show a recorded or live run in Rerun."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path

import click

from lathe_live.rerun_bag import write
from lathe_live.rerun_output import Viewer, end_viewer, require, viewer
from lathe_rc.bag.reading.source import name_of
from lathe_rc.cell.beside import RERUN_PORT, RERUN_RATE, RerunOutput
from lathe_rc.commands import lossy, options
from lathe_rc.errors import InputError, LatheError


def _show(bag: Path, rate: float, shown: Viewer) -> None:
    """Show a bag in the Rerun viewer until the viewer ends."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name_of(bag)}.rrd"
        write(bag, file, rate=rate)
        click.echo(shown.message)
        with shown.start(file) as process:
            try:
                if process.wait():
                    raise LatheError(f"Rerun ended with code {process.returncode}")
            except KeyboardInterrupt:
                end_viewer(process)


def _live(values: Mapping[str, object], *, as_json: bool) -> None:
    """Show the live runs of this ROS domain until Ctrl-C."""
    from lathe_live.nodes import rerun_bridge

    runs = rerun_bridge.run(values, ["--ros-args"])
    if as_json:
        click.echo(json.dumps({"runs": [vars(run) | {"file": run.file and str(run.file)} for run in runs]}))


@click.command()
@click.argument("bag", type=options.PATH, required=False)
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False), help="write a .rrd file, show nothing")
@click.option("--web", is_flag=True, help="show it in a browser")
@click.option("--port", type=click.IntRange(1, 65535), default=RERUN_PORT, show_default=True, help="of the web page")
@click.option(
    "--rate",
    type=click.FloatRange(min=1),
    default=RERUN_RATE,
    show_default=True,
    help="points of a curve in a second, at most: smallest and largest values in turn",
)
@click.option("--live", is_flag=True, help="no BAG: what runs in this ROS domain, one run after the other")
@click.option("--connect", metavar="URL", help="live: in a viewer that runs already, rerun+http://HOST:PORT/proxy")
@click.option("--scenario", metavar="SCENARIO", help="live: of the cell; its length and feed scale the part")
@click.option("--once", is_flag=True, help="live: end with the first run")
@click.option("--json", "as_json", is_flag=True, help="live: print one JSON object at the end")
def view(
    bag: Path | None,
    output: Path | None,
    port: int,
    rate: float,
    connect: str | None,
    scenario: str | None,
    *,
    web: bool,
    live: bool,
    once: bool,
    as_json: bool,
) -> None:
    """Show a BAG in Rerun: the part in three dimensions, form error, signals and learning, revolution by revolution."""
    places = {"--output": output, "--web": web, "--connect": connect}
    if len(given := [name for name, value in places.items() if value]) > 1:
        raise InputError(f"{' with '.join(given)}; allowed: one of them")
    if (bag is None) != live:
        raise InputError("a BAG with --live; allowed: one of them" if bag else "no BAG; name one, or --live")
    if not live and (connect or scenario or once or as_json):
        raise InputError("--connect, --scenario, --once and --json are for --live")
    require()
    if bag is None:
        where: RerunOutput = "save" if output else "serve" if web else "connect" if connect else "spawn"
        values = {"output": where, "file": str(output or ""), "url": connect or "", "port": port, "rate": rate}
        _live({**values, "scenario": scenario or "", "once": once}, as_json=as_json)
    elif output:
        write(bag, output, rate=rate)
        size = output.stat().st_size
        click.echo(f"view: {output} ({size / 1e6:.1f} MB)")
        lossy.end(bag)
    else:
        lossy.tell([bag])
        _show(bag, rate, viewer("serve" if web else "spawn", port))
