# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe measure``: a recorded part as the workshop measures it, revolution by revolution."""

import json
import re
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.table import Table as RichTable

from lathe_rc.analysis import profile_csv
from lathe_rc.analysis.metrology import Measurement, measure
from lathe_rc.bag import reader
from lathe_rc.cell import messages
from lathe_rc.cell.recording import Recording
from lathe_rc.errors import InputError

_SHOWN = 10  # revolutions, unless others are asked for
_COLUMNS = ("rev", "RMS", "max", "P-V", "RONt", "eccentric", "largest UPR", "Ra")


def part(recording: Recording, *, cutoff: float = 50.0) -> Measurement:
    """The part that a run has turned; see `lathe_rc.analysis.metrology.measure`.

    Args:
        recording: of the run; with a tool.
        cutoff: of the filters for roundness and roughness [undulations per revolution].

    Raises:
        InputError: it has no tool, or not one complete revolution.
    """
    if not {messages.TOOL, messages.ENCODER} <= set(recording.types.values()):
        raise InputError("nothing to measure: the recording has no encoder and tool; record both")
    angle, error = (
        recording.of_type(kind)[field] for kind, field in ((messages.ENCODER, "angle_true"), (messages.TOOL, "error"))
    )
    found = measure(angle, error, roundness_cutoff=cutoff, roughness_cutoff=cutoff)
    if not found.form.rms.size:
        raise InputError("nothing to measure: the recording has no complete revolution; let it run longer")
    return found


def numbers(found: Measurement, revolution: int) -> dict[str, Any]:
    """What is told of one revolution, counted from 0; lengths in µm."""
    around, waves = found.roundness, found.undulations.amplitude[revolution]
    largest = int(np.argmax(waves[2:])) + 2  # 0 is the size of the part, 1 its place

    def um(values: np.ndarray) -> float:
        return float(values[revolution]) * 1e6

    return {
        "revolution": revolution % found.form.rms.size + 1,
        "rms": um(found.form.rms),
        "max": um(found.form.largest),
        "peak_to_valley": um(found.form.peak_to_valley),
        "ront": um(around.peak_to_valley),
        "ronq": um(around.rms),
        "centre": [um(around.x), um(around.y)],
        "largest_upr": {"upr": largest, "amplitude": float(waves[largest]) * 1e6},
        "ra": um(found.roughness.ra),
    }


def table(found: Measurement, revolutions: list[int]) -> RichTable:
    """One line a revolution, in µm."""
    lines = RichTable(title="form error and roundness [µm]", title_justify="left", show_edge=False, header_style="bold")
    for column in _COLUMNS:
        lines.add_column(column, justify="right")
    for revolution in revolutions:
        told = numbers(found, revolution)
        upr = told["largest_upr"]
        lines.add_row(
            str(told["revolution"]),
            *(f"{told[name]:#.4g}" for name in ("rms", "max", "peak_to_valley", "ront")),
            f"{np.hypot(*told['centre']):.3g}",
            f"{upr['upr']}: {upr['amplitude']:.3g}",
            f"{told['ra']:.3g}",
        )
    return lines


def write_profile(path: Path, recording: Recording, found: Measurement, revolutions: list[int]) -> None:
    """Write radius deviations as CSV, with the heights along the part if it was fed."""
    heights = None
    if len(revolutions) > 1:
        height = recording.of_type(messages.TOOL)["height"]
        starts = found.form.starts
        heights = np.array([height[starts[k] : starts[k + 1]].mean() for k in revolutions])
        if np.ptp(heights) == 0.0:
            heights = None
    radius = found.profile[revolutions] if len(revolutions) > 1 else found.profile[revolutions[0]]
    named = ", ".join(str(k + 1) for k in revolutions)
    profile_csv.write(path, radius, heights=heights, comment=f"deviation from the desired form, revolution {named}")


def _chosen(text: str, whole: int) -> list[int]:
    """Revolutions, counted from 0, that a text such as 1,4,10-12 names; without one, some spread over all."""
    if not text:
        return sorted(set(np.unique(np.geomspace(1, whole, _SHOWN).round().astype(int) - 1).tolist()))
    chosen: list[int] = []
    for piece in text.split(","):
        span = re.fullmatch(r"(\d+)(?:-(\d+))?", piece.strip(), re.ASCII)
        if not span:
            raise InputError(f"--revolutions {text!r}; allowed: numbers and ranges from 1 to {whole}, like 1,4,10-12")
        chosen += range(int(span[1]) - 1, int(span[2] or span[1]))
    if not chosen or min(chosen) < 0 or max(chosen) >= whole:
        raise InputError(f"--revolutions {text!r}; allowed: from 1 to {whole}, the recording's complete revolutions")
    return chosen


@click.command("measure")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--revolutions", default="", metavar="LIST", help="like 1,4,10-12; default: some from all of the run")
@click.option(
    "--cutoff",
    type=click.FloatRange(min=0, min_open=True),
    default=50.0,
    show_default=True,
    help="of the filters for roundness and roughness [undulations per revolution]",
)
@click.option("--profile", type=click.Path(path_type=Path), help="CSV file to write these revolutions' profiles to")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def command(bag: Path, revolutions: str, cutoff: float, profile: Path | None, *, as_json: bool) -> None:
    """Measure the part that a recorded run has turned: form error, roundness, roughness by revolution."""
    recording = reader.read(bag)
    found = part(recording, cutoff=cutoff)
    chosen = _chosen(revolutions, found.form.rms.size)
    if profile:
        write_profile(profile, recording, found, chosen)
    if as_json:
        told = {
            "bag": str(bag),
            "cutoff_upr": cutoff,
            "unit": "um",
            "revolutions": [numbers(found, k) for k in chosen],
            "profile": str(profile) if profile else None,
        }
        click.echo(json.dumps(told))
        return
    console = Console()
    console.print(table(found, chosen))
    if profile:
        console.print(f"profile: {profile}", highlight=False, soft_wrap=True)
