# SPDX-License-Identifier: Apache-2.0
"""``lathe view BAG -o FILE.rrd`` is compared with ``rr.log`` of single samples from the same bag of the piston.

Figures are samples per second over the curves of a view. ``lathe_view`` reads the bag and writes the file as the
command does: curves thinned to extremes (no peak is lost), the part in three dimensions, error map, spectra.
``lathe_view_every_sample`` keeps all samples. ``rr_log`` only sets the time and logs one scalar at a time, for the
first samples of the bag, from arrays in memory. A ratio is the rate over that of ``rr_log``.

If rerun is not installed, ``reason`` says so in place of figures.
"""

import importlib.util
import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

from benchmarks import sides
from lathe_rc import harness, resources
from lathe_rc.cell import scenario
from lathe_rc.cell.recording import Recording

_ALL = 1e9  # points of a curve in a second: more than there are


def _log(file: Path, recording: Recording, samples: int, step: float) -> int:
    """Log single samples of every curve to a file; returns how many."""
    import rerun as rr

    from lathe_live.rerun_signals import curve_path, curves

    drawn = [
        (curve_path(topic, field), recording.dense[topic][field] * curve.scale)
        for topic, fields in curves(recording.types).items()
        for field, curve in fields.items()
    ]
    to = rr.RecordingStream("lathe_rc")
    to.save(file)
    for k in range(samples):
        to.set_time("time", duration=k * step)
        for path, values in drawn:
            to.log(path, rr.Scalars(values[k]))
    to.flush()
    to.disconnect()
    return samples * len(drawn)


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Export against single logs."""
    if importlib.util.find_spec("rerun_bindings") is None:
        return {"reason": "rerun is not installed (pip install rerun-sdk)"}
    from lathe_live.rerun_bag import write
    from lathe_live.rerun_signals import curves

    rounds = 2 if quick else 5
    piston = scenario.load(
        resources.find(Path("piston.yaml")), [f"spindle_encoder.revolutions={15.0 if quick else 60.0}"]
    )
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as name:
        folder, numbers = Path(name), count()
        run = harness.run(piston, bag=folder / "bag")
        number = sum(len(fields) for fields in curves(run.recording.types).values())
        sizes: dict[str, float] = {}

        def export(side: str, rate: float) -> Callable[[], float]:
            def once() -> float:
                file = folder / f"{next(numbers)}.rrd"
                seconds = sides.seconds(lambda: write(folder / "bag", file, rate=rate))
                sizes[side] = file.stat().st_size * 1e-6
                return run.samples * number / seconds

            return once

        def log() -> float:
            file, samples = folder / f"{next(numbers)}.rrd", 300 if quick else 5000
            seconds = sides.seconds(lambda: _log(file, run.recording, samples, piston.shared.step))
            return samples * number / seconds

        every = {
            "lathe_view": export("lathe_view", 2000.0),
            "lathe_view_every_sample": export("lathe_view_every_sample", _ALL),
            "rr_log": log,
        }
        say("  a first export")
        every["lathe_view"]()  # compiles
        say("  exports and single logs")
        found = sides.alternate(every, rounds)
    return {
        "samples": run.samples,
        "curves": number,
        **{
            side: {"samples_per_s": sides.spread(rates), "ratio": sides.ratio(rates, found["rr_log"])}
            | ({"file_mb": sizes[side]} if side in sizes else {})
            for side, rates in found.items()
        },
    }
