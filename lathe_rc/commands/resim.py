# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe resim``: a recorded run again, behind the same spindle, as it was or with another controller."""

import json
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table as RichTable

from lathe_rc.bag.resim import Resimulation, resimulate

_SHOWN = 10  # revolutions
_DIFFERENT = 1  # exit code if an unchanged run does not come out as recorded


def _table(found: Resimulation) -> RichTable:
    """Recorded and re-simulated form error side by side."""
    table = RichTable(title="form error, RMS [µm]", title_justify="left", show_edge=False, header_style="bold")
    for column in ("revolution", "recorded", "re-simulated", "ratio"):
        table.add_column(column, justify="right")
    whole = min(found.rms.size, found.recorded_rms.size)
    for k in sorted(set(np.unique(np.geomspace(1, whole, _SHOWN).round().astype(int) - 1).tolist())):
        old, new = found.recorded_rms[k] * 1e6, found.rms[k] * 1e6
        table.add_row(str(k + 1), f"{old:#.4g}", f"{new:#.4g}", f"{new / old:.3g}" if old else "")
    return table


@click.command()
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--set", "overrides", multiple=True, metavar="NODE.PARAM=VALUE", help="repeatable; not of the spindle")
@click.option("--controller", type=click.Path(path_type=Path), help="parameter file whose nodes replace the bag's")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="folder of a bag for the result; must not exist")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@click.pass_context
def resim(
    ctx: click.Context,
    bag: Path,
    overrides: tuple[str, ...],
    controller: Path | None,
    output: Path | None,
    *,
    as_json: bool,
) -> None:
    """Run the cell of a BAG again behind its recorded spindle; unchanged, every bit must come out as recorded."""
    found = resimulate(bag, overrides, controller=controller, output=output)
    told = {
        "bag": str(bag),
        "changed": found.changed,
        "equal": not found.different,
        "different": found.different,
        "simulated_s": found.simulated_s,
        "wall_s": found.wall_s,
        "real_time_factor": found.simulated_s / found.wall_s,
        "rms_um": (found.rms * 1e6).tolist(),
        "recorded_rms_um": (found.recorded_rms * 1e6).tolist(),
        "output": str(output) if output else None,
        "digest": dict(found.digest),
    }
    wrong = bool(found.different) and not found.changed and bool(found.recorded)
    if as_json:
        click.echo(json.dumps(told))
        ctx.exit(_DIFFERENT if wrong else 0)
    console = Console(highlight=False, soft_wrap=True)
    if found.changed and found.rms.size:
        console.print(_table(found))
    if not found.recorded:
        console.print("the recording is not complete: nothing to compare the whole with")
    elif not found.different:
        console.print(f"equal to the recording to the bit: {len(found.digest)} topics, {found.samples} samples")
    else:
        console.print(f"different from the recording: {', '.join(found.different)}")
    factor = found.simulated_s / found.wall_s
    console.print(f"{found.simulated_s:.2f} s simulated in {found.wall_s:.2f} s: {factor:.1f}x real time")
    if output:
        console.print(f"bag: {output}")
    ctx.exit(_DIFFERENT if wrong else 0)
