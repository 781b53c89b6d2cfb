# SPDX-License-Identifier: Apache-2.0
"""Command group ``lathe export``: signals of a bag as tables; stages as C libraries, FMUs, SSP or components of HAL."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lathe_rc.commands import completers, lossy, options
from lathe_rc.errors import InputError, LossyRunError

if TYPE_CHECKING:
    from lathe_export.c_library.library import Library

_TUNE = click.option(
    "--tune",
    multiple=True,
    metavar="NODE[.PARAM]",
    help="a further parameter that may be changed, or all of a node that can; repeatable",
)


@click.group(cls=options.GroupWithDefault, default="bag")
def export() -> None:
    """Export a recording as tables, or stages as C, FMU or HAL component; without a command: a recording."""


@export.command()
@options.bag
@click.option("--csv", "kinds", flag_value="csv", multiple=True, help="a CSV file for each topic")
@click.option("--parquet", "kinds", flag_value="parquet", multiple=True, help="a Parquet file for each topic")
@click.option("--npz", "kinds", flag_value="npz", multiple=True, help="one NumPy archive")
@click.option(
    "-o",
    "--output",
    type=options.PATH,
    help="folder, for --npz file, to make; must not exist; default: BAG-csv, BAG-parquet or BAG.npz, here",
)
@options.topics("all signals, or all topics of a recording without blocks")
@click.pass_context
def bag(ctx: click.Context, bag: Path, kinds: tuple[str, ...], output: Path | None, topics: tuple[str, ...]) -> None:
    """Export the topics of a recording, with units.

    Exit code 3: samples or messages of these topics are not in the tables.
    """
    if len(kinds) != 1:
        raise InputError(f"{len(kinds)} formats; allowed: one of --csv, --parquet and --npz")
    from lathe_export.tables import export as exporting
    from lathe_rc.bag.reading.source import name_of

    (kind,) = kinds
    name = name_of(bag).removesuffix(".mcap")
    place = output or Path(f"{name}.npz" if kind == "npz" else f"{name}-{kind}")
    done = exporting.export_bag(bag, place, kind, topics)
    for line in done.left_out:
        click.echo(f"left out: {line}", err=True)
    if done.others:
        click.echo(f"not exported, unless named by --topics: {', '.join(done.others)}", err=True)
    click.echo(f"{len(done.rows)} topics, {sum(done.rows.values())} rows: {done.place}")
    lost = lossy.tell([bag])
    ctx.exit(LossyRunError.exit_code if lost or done.left_out else 0)


@export.command("c")
@click.argument("nodes", nargs=-1, metavar="[NODE]...", shell_complete=completers.nodes)
@click.option("--scenario", required=True, shell_complete=completers.scenarios, help="whose tables the nodes have")
@options.overrides
@click.option("--name", help="of the library, a C identifier; default: that of the node or, if several, the scenario")
@click.option("-o", "--output", type=options.PATH, help="folder to make; must not exist; default: NAME-c, here")
@click.option("--block", type=int, help="most samples in a call, and the delay of fed-back inputs; default: block_size")
@_TUNE
@click.option(
    "--real",
    type=click.Choice(["double", "float"]),
    default="double",
    show_default=True,
    help="type of real numbers; float for processors without double, the README states its loss",
)
@click.option(
    "--samples",
    type=click.IntRange(1),
    default=65536,
    show_default=True,
    help="of the engine's run with which the example compares the library",
)
@options.allow_code
def c_library(
    nodes: tuple[str, ...], scenario: str, overrides: tuple[str, ...], output: Path | None, **how: Any
) -> None:
    """Export NODEs of a scenario, wired together, as a C library that needs no Python; none: all of them."""
    from lathe_export.c_library.sources import export_nodes
    from lathe_rc.commands import scenario as scenarios

    done = export_nodes(scenarios.load(scenario, overrides), nodes, output, **how)
    _tell(done.library, "not in the library, the program has to cause it")
    exported = ", ".join(part.stage.name for part in done.library.parts)
    click.echo(f"{done.place}: {exported}; state of {done.library.size} bytes")
    click.echo(f"next: cd {done.place} && cmake -B build && cmake --build build && build/{done.library.name}_main")


def _tell(library: "Library", left_out: str) -> None:
    """Print what the checks of the cell leave in doubt, and what a running cell could do that the code cannot."""
    for line in library.cell.warnings:
        click.echo(f"warning: {line}", err=True)
    for line in library.cell.unchecked:
        click.echo(f"not checked: {line}", err=True)
    for line in library.left_out:
        click.echo(f"warning: {left_out}: {line}", err=True)
    if library.fixed:
        names = ", ".join(library.fixed)
        click.echo(f"fixed, since they act by way of tables: {names}; for other values export again", err=True)


@export.command()
@click.argument("nodes", nargs=-1, metavar="[NODE]...", shell_complete=completers.nodes)
@click.option("--scenario", required=True, shell_complete=completers.scenarios, help="whose tables the nodes have")
@options.overrides
@click.option("--name", help="of the model, a C identifier; default: that of the node or, if several, the scenario")
@click.option("-o", "--output", type=options.PATH, help="file to make; must not exist; default: NAME.fmu, here")
@click.option("--fmi", type=click.Choice(["2", "3"]), default="3", show_default=True, help="version of FMI: 2.0 or 3.0")
@_TUNE
@click.option(
    "--platform",
    multiple=True,
    default=("linux64",),
    show_default=True,
    type=click.Choice(["linux64", "win64"]),
    help="of a binary; win64 needs the compiler mingw-w64; repeatable",
)
@options.allow_code
def fmu(
    nodes: tuple[str, ...], scenario: str, overrides: tuple[str, ...], output: Path | None, fmi: str, **how: Any
) -> None:
    """Export NODEs of a scenario, wired together, as an FMU for co-simulation; none: all of them."""
    from lathe_export.c_library.fmu import export_fmu
    from lathe_rc.commands import scenario as scenarios

    place, library = export_fmu(scenarios.load(scenario, overrides), nodes, output, fmi=int(fmi), **how)
    _tell(library, "not in the FMU, the importer has to cause it")
    exported = ", ".join(part.stage.name for part in library.parts)
    counts = f"{len(library.inputs)} inputs, {len(library.outputs)} outputs, {len(library.parameters)} parameters"
    click.echo(f"{place}: {exported}; {counts}, a step of {library.step:.9g} s")


@export.command()
@click.argument("node", shell_complete=completers.nodes)
@click.option("--scenario", required=True, shell_complete=completers.scenarios, help="whose table the node has")
@options.overrides
@click.option("--name", help="of the component, a C identifier; default: that of the node")
@click.option("-o", "--output", type=options.PATH, help="folder to make; must not exist; default: NAME-hal, here")
@_TUNE
@options.allow_code
def hal(node: str, scenario: str, overrides: tuple[str, ...], output: Path | None, **how: Any) -> None:
    """Export a NODE of a scenario as a component for HAL, the hardware layer of LinuxCNC."""
    from lathe_export.c_library.hal import export_hal
    from lathe_rc.commands import scenario as scenarios

    done = export_hal(scenarios.load(scenario, overrides), node, output, **how)
    _tell(done.library, "not in the component, HAL has to cause it")
    click.echo(f"{done.place}: {node}, {done.library.step * 1e9:.9g} ns a sample; state of {done.library.size} bytes")
    click.echo(f"next: cd {done.place} && make && sudo make install")


@export.command()
@click.option("--scenario", required=True, shell_complete=completers.scenarios, help="whose tables the nodes have")
@options.overrides
@click.option("-o", "--output", type=options.PATH, help="file to make; must not exist; default: SCENARIO.ssp, here")
@options.allow_code
def ssp(scenario: str, overrides: tuple[str, ...], output: Path | None) -> None:
    """Export the cell of a scenario as connected FMUs, one for each stage (SSP 1.0, FMI 2.0)."""
    from lathe_export.c_library.ssp import connections, export_ssp
    from lathe_rc.commands import scenario as scenarios

    place, libraries = export_ssp(scenarios.load(scenario, overrides), output)
    for line in (line for library in libraries.values() for line in library.left_out):
        click.echo(f"warning: not in the system, the importer has to cause it: {line}", err=True)
    click.echo(f"{place}: {len(connections(libraries))} connections; step in this order: {', '.join(libraries)}")
