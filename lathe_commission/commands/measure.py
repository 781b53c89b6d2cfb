# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe measure``: workshop measurements of a recorded part by revolution."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import RenderableType

from lathe_rc.analysis.metrology import Lay, Measurement
from lathe_rc.bag import provenance, reader
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell.recording import Recording
from lathe_rc.commands import lossy, measured, options, tables
from lathe_rc.errors import InputError, LatheError
from lathe_rc.judge import part

_COLUMNS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "rev": lambda row: str(row["revolution"]),
    "RMS": lambda row: f"{row['rms']:#.4g}",
    "max": lambda row: f"{row['max']:#.4g}",
    "P-V": lambda row: f"{row['peak_to_valley']:#.4g}",
    "RONt": lambda row: f"{row['ront']:#.4g}",
    "eccentric": lambda row: f"{np.hypot(*row['centre']):.3g}",
    "largest UPR": lambda row: f"{row['largest_upr']['upr']}: {row['largest_upr']['amplitude']:.3g}",
    "Ra": lambda row: f"{row['ra']:.3g}",
}


def _chosen(text: str, whole: int) -> list[int]:
    """Parse revolutions such as 1,4,10-12 into indices from 0; an empty text selects some spread over the run."""
    if not text:
        return tables.spread(whole)
    chosen: list[int] = []
    for piece in text.split(","):
        span = re.fullmatch(r"(\d+)(?:-(\d+))?", piece.strip(), re.ASCII)
        if not span:
            raise InputError(f"--revolutions {text!r}; allowed: numbers and ranges from 1 to {whole}, like 1,4,10-12")
        chosen += range(int(span[1]) - 1, int(span[2] or span[1]))
    if not chosen or min(chosen) < 0 or max(chosen) >= whole:
        raise InputError(f"--revolutions {text!r}; allowed: from 1 to {whole}, the recording's complete revolutions")
    return chosen


def _surface(bag: Path, recording: Recording, found: Measurement, nose_mm: float | None) -> Lay | str | None:
    """Return the surface along the part, or the reason for its absence; None without a nose radius in command or bag.

    Raises:
        InputError: the command names a nose radius, but there is no surface.
    """
    if nose_mm:
        return part.surface(recording, found, nose_mm * 1e-3)
    with BagSource(bag) as source:
        about = source.about
    try:
        radius = part.nose_radius(provenance.judged(about))
        return part.surface(recording, found, radius) if radius else None
    except InputError as error:
        return str(error)


@click.command()
@options.bag
@click.option("--revolutions", default="", metavar="LIST", help="like 1,4,10-12; default: some from all of the run")
@click.option(
    "--cutoff",
    type=options.POSITIVE,
    default=50.0,
    show_default=True,
    help="of the filters for roundness and roughness [undulations per revolution]",
)
@click.option(
    "--nose-radius",
    type=options.POSITIVE,
    metavar="MM",
    help="radius of the tool's nose in the plane of the feed [mm]: tells the roughness along the part too; default: "
    "what the scenario in the bag says",
)
@click.option("--profile", type=options.PATH, help="CSV file to write these revolutions' profiles to")
@options.as_json
def measure(
    bag: Path, revolutions: str, cutoff: float, nose_radius: float | None, profile: Path | None, *, as_json: bool
) -> None:
    """Measure the part turned in a recorded run: form error, roundness and roughness by revolution."""
    measured.tell_origin(bag)
    recording = reader.read_bag(bag)
    found = part.measured(recording, cutoff=cutoff)
    surface = _surface(bag, recording, found, nose_radius)
    chosen = _chosen(revolutions, found.form.rms.size)
    if profile:
        part.write_profile(profile, recording, found, chosen)
    rows, why = [part.numbers(found, k) for k in chosen], recording.sound_form[1]
    summary = {
        "bag": str(bag),
        "cutoff_upr": cutoff,
        "unit": "um",
        "revolutions": rows,
        "along": part.along(surface) if isinstance(surface, Lay) else surface,
        "profile": str(profile) if profile else None,
        "not_measured": why or None,
    }
    text: list[RenderableType] = [tables.of_rows(rows, _COLUMNS, title="form error and roundness [µm]")]
    if why:
        text += [f"revolutions from {recording.turns_before + found.form.rms.size + 1} on: {why}"]
    if surface:
        text += [part.along_in_words(surface) if isinstance(surface, Lay) else surface]
    if profile:
        text += [f"profile: {profile}"]
    tables.show(summary, text, as_json=as_json)
    lossy.end(bag)
    if why:  # the form error rests on a fault
        raise click.exceptions.Exit(LatheError.exit_code)
