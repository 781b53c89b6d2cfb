# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe panel``: a page in the browser that shows a cell at work and commands it."""

from pathlib import Path

import click

from lathe_rc import allowed_code
from lathe_rc.commands import lossy, measured, options
from lathe_rc.errors import InputError


@click.command()
@options.scenario
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="of the page; default: a free one")
@click.option("--no-browser", is_flag=True, help="only print the address of the page")
@click.option("--pace", type=click.FloatRange(0, 1000), default=1.0, show_default=True, help="0: as fast as possible")
@click.option("--revolutions", type=options.POSITIVE, help="length of the run")
@options.start_from
@click.option("--attach", is_flag=True, help="show the cell of SCENARIO that runs in this ROS domain")
@click.option("--namespace", default="/", show_default=True, help="attach: of the cell's nodes")
@options.overrides
@options.allow_code
def panel(
    scenario: str,
    port: int,
    pace: float,
    revolutions: float | None,
    start_from: Path | None,
    namespace: str,
    overrides: tuple[str, ...],
    *,
    attach: bool,
    no_browser: bool,
) -> None:
    """Show a SCENARIO at work on one page in the browser, which also commands it, without ROS or network.

    Instead of a scenario, a bag is played. Ctrl-C ends it.
    """
    from lathe_live import page_server
    from lathe_live import panel as panels
    from lathe_live.panel_run import Driver, LiveCell

    if measured.is_bag(Path(scenario)):
        given = {"--revolutions": revolutions, "--from": start_from, "--set": overrides, "--attach": attach}
        if wrong := [name for name, value in given.items() if value]:
            raise InputError(f"{wrong[0]} with the bag {scenario}; allowed: with a scenario")
        from lathe_live.panel_player import Player

        click.echo(f"reading {scenario}", err=True)
        player = Player(Path(scenario))
        lossy.tell([Path(scenario)])
        with Driver(player, pace) as driver:
            page_server.serve(panels.player_site(driver, player), port, click.echo, browser=not no_browser)
        return
    from lathe_live.loop_page import LoopPage
    from lathe_live.varied_loop import VariedLoop
    from lathe_rc.commands import scenario as scenarios

    allowed_code.allow_own_code()
    loaded = scenarios.load(scenario, overrides, revolutions=revolutions, start_from=start_from)
    loop = LoopPage(VariedLoop(loaded), Path(f"{loaded.name}-loop.yaml")).site()
    if attach:
        from lathe_live.nodes import panel_attach

        panel_attach.attach(loaded, namespace, port, click.echo, browser=not no_browser, loop=loop)
        return
    cell = LiveCell(loaded, compiling=lambda names: click.echo(f"compiling {', '.join(names)}", err=True))
    with Driver(cell, pace) as driver:
        site = panels.with_loops(panels.site(driver, cell), loop)
        page_server.serve(site, port, click.echo, browser=not no_browser)
