# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe loop``: block diagram and learning loops of a scenario, with settings that can be dragged."""

import shlex
from pathlib import Path

import click

from lathe_rc.commands import options


@click.command()
@options.scenario
@options.overrides
@options.length
@click.option("-o", "--output", type=options.PATH, help="scenario that the page writes; default: SCENARIO-loop.yaml")
@click.option("--html", type=options.PATH, help="write the page to a file instead, with the values of the scenario")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="TCP port on 127.0.0.1; default: a free one")
@click.option("--no-browser", is_flag=True, help="print the address without opening it")
@options.allow_code
def loop(
    scenario: str,
    overrides: tuple[str, ...],
    revolutions: float | None,
    output: Path | None,
    html: Path | None,
    port: int,
    *,
    no_browser: bool,
) -> None:
    """Show the block diagram and the learning loops of a SCENARIO in the browser (docs/view.md).

    Lead, Q and gain can be dragged; margins, curves and the form error of a short run follow.
    """
    from lathe_live import page_server
    from lathe_live.loop_page import LoopPage
    from lathe_live.varied_loop import VariedLoop
    from lathe_rc import files
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.drawing.pages import check_page, write_page

    loaded = scenarios.load(scenario, overrides)
    place = output or Path(f"{loaded.name}-loop.yaml")
    if html is not None:
        check_page(html, "--html")
        given = [part for text in overrides for part in ("--set", text)]
        page = LoopPage(VariedLoop(loaded, revolutions), place)
        write_page(html, page.document(shlex.join(["lathe", "loop", scenario, *given, "--html", str(html)])))
        click.echo(f"loop: {html}")
        return
    files.check_place("--output", place)
    site = LoopPage(VariedLoop(loaded, revolutions), place).site()
    page_server.serve(site, port, click.echo, browser=not no_browser)
