# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe view``: a recorded run in Rerun."""

import json
import os
import tempfile
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from rich.console import Console

from lathe_rc import messages
from lathe_rc.bag.reading import stream
from lathe_rc.bag.reading.source import Source
from lathe_rc.cell.block import Block
from lathe_rc.cell.rerun_bridge import PORT, RATE, Kind
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import START_NS
from lathe_rc.view.rerun_output import Viewer, end, require, viewer

if TYPE_CHECKING:
    import rerun as rr

    from lathe_rc.view.rerun_part import Outlook

_PIECE = 65536  # samples
_END_NS = 1_000_000_000  # before the end of a bag, where its last blocks are looked for
_POINTS = 300_000  # of a curve: a long bag gets fewer in a second


def _first(source: Source, topic: str) -> Block:
    """The first block of a topic."""
    try:
        return next(source.blocks(topic))
    except (StopIteration, LatheError) as error:
        raise InputError(f"{source.path}: {topic} has no whole block ({error})") from None


def _last(source: Source, topic: str) -> Block | None:
    """The last block of a topic, if it is near the end of the bag."""
    try:
        newest = deque(source.blocks(topic, start_ns=source.last_ns - _END_NS), maxlen=1)
    except LatheError as error:
        raise InputError(f"{source.path}: {topic} has no whole block ({error})") from None
    return newest[0] if newest else None


def _foresee(path: Path) -> tuple[dict[str, str], int, float, "Outlook"]:
    """Signal topics with their types, step [ns], length [s] and outlook of a bag."""
    from lathe_rc.view.rerun_part import Outlook

    with Source(path) as source:
        types = {topic: kind.type for topic, kind in source.topics.items() if kind.type in messages.signal_types()}
        filled = {kind: t for t, kind in reversed(types.items()) if source.topics[t].count}  # first topic of each type
        blocks = [kind for kind in filled if kind in messages.block_types()]
        if not blocks:
            raise InputError(f"{path}: nothing to show: the bag has no blocks of a cell")
        first = {kind: _first(source, filled[kind]) for kind in blocks}
        last = {kind: _last(source, filled[kind]) for kind in (messages.ENCODER, messages.TOOL) if kind in first}
        turned = travel = 0.0
        if encoder := last.get(messages.ENCODER):
            turned = float(encoder.signals["angle_true"][-1]) / (2.0 * np.pi)
        if tool := last.get(messages.TOOL):
            travel = float(tool.signals["height"][-1] - first[messages.TOOL].signals["height"][0])
        step_ns = first[blocks[0]].step_ns
        if not step_ns or not np.isfinite([turned, travel]).all():
            raise InputError(
                f"{path}: step {step_ns} ns, {turned:g} turns, {travel:g} m along the part: not a cell's bag"
            )
        return types, step_ns, (source.last_ns - START_NS) * 1e-9, Outlook(turned, travel)


def log(recording: "rr.RecordingStream", bag: Path, *, rate: float) -> int:
    """Log a bag.

    Args:
        recording: with a sink; stays open.
        bag: the bag.
        rate: points of a curve in a second, at most.

    Returns:
        Samples of each signal.

    Raises:
        InputError: not a bag of a cell.
        LatheError: the bag is not whole, or the recording cannot be written.
    """
    from lathe_rc.view.rerun_blueprint import blueprint
    from lathe_rc.view.rerun_scene import Scene

    types, step_ns, length, outlook = _foresee(bag)
    scene = Scene(recording, types, step_ns, outlook=outlook, rate=min(rate, _POINTS / max(length, 1e-9)))
    recording.send_blueprint(blueprint(types))
    header = stream.feed(bag, [scene], piece=max(scene.window, _PIECE // scene.window * scene.window))
    scene.close()
    try:
        recording.flush()
    except (RuntimeError, ValueError) as error:
        raise LatheError(f"the view cannot be written ({shown(error)})") from None
    return header.samples


def write(bag: Path, output: Path, *, rate: float = RATE) -> int:
    """Write a bag's .rrd file: whole, or not at all.

    Returns:
        Samples of each signal.

    Raises:
        InputError: not a bag of a cell, or a file that cannot be made.
        LatheError: the bag is not whole, or the disk is full.
    """
    import rerun as rr

    if not output.parent.is_dir():
        raise InputError(f"{output}: there is no folder {output.parent}")
    recording = rr.RecordingStream("lathe_rc", recording_id=bag.resolve().name)
    beside = output.with_name(f".{output.name}.{os.getpid()}")
    try:
        try:
            recording.save(beside)
        except RuntimeError as error:
            raise InputError(f"{output}: cannot be written ({error})") from None
        samples = log(recording, bag, rate=rate)
        recording.disconnect()
        beside.replace(output)
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror})") from None
    finally:
        recording.disconnect()
        beside.unlink(missing_ok=True)
    return samples


def _show(bag: Path, rate: float, shown: Viewer) -> None:
    """Show a bag with Rerun's own program until it ends."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{bag.resolve().name}.rrd"
        write(bag, file, rate=rate)
        click.echo(shown.said)
        with shown.start(file) as process:
            try:
                if process.wait():
                    raise LatheError(f"Rerun ended with code {process.returncode}")
            except KeyboardInterrupt:
                end(process)


def _live(values: Mapping[str, object], *, as_json: bool) -> None:
    """Show what runs in this domain until Ctrl-C."""
    from lathe_rc.nodes import rerun_bridge

    runs = rerun_bridge.run(values, ["--ros-args"])
    if as_json:
        click.echo(json.dumps({"runs": [vars(run) | {"file": run.file and str(run.file)} for run in runs]}))


@click.command()
@click.argument("bag", type=click.Path(path_type=Path), required=False)
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False), help="write a .rrd file, show nothing")
@click.option("--web", is_flag=True, help="show it in a browser")
@click.option("--port", type=click.IntRange(1, 65535), default=PORT, show_default=True, help="of the web page")
@click.option(
    "--rate",
    type=click.FloatRange(min=1),
    default=RATE,
    show_default=True,
    help="points of a curve in a second, at most: smallest and largest values in turn",
)
@click.option("--live", is_flag=True, help="no BAG: what runs in this ROS domain, one run after the other")
@click.option("--connect", metavar="URL", help="live: in a viewer that runs already, rerun+http://HOST:PORT/proxy")
@click.option("--once", is_flag=True, help="live: end with the first run")
@click.option("--json", "as_json", is_flag=True, help="live: print one JSON object at the end")
def view(
    bag: Path | None,
    output: Path | None,
    port: int,
    rate: float,
    connect: str | None,
    *,
    web: bool,
    live: bool,
    once: bool,
    as_json: bool,
) -> None:
    """Show a BAG in Rerun: the part in three dimensions, form error, signals, learning, revolution by revolution."""
    places = {"--output": output, "--web": web, "--connect": connect}
    if len(given := [name for name, value in places.items() if value]) > 1:
        raise InputError(f"{' with '.join(given)}; allowed: one of them")
    if (bag is None) != live:
        raise InputError("a BAG with --live; allowed: one of them" if bag else "no BAG; name one, or --live")
    if not live and (connect or once or as_json):
        raise InputError("--connect, --once and --json are for --live")
    require()
    if bag is None:
        where: Kind = "save" if output else "serve" if web else "connect" if connect else "spawn"
        values = {"output": where, "file": str(output or ""), "url": connect or "", "port": port, "rate": rate}
        _live({**values, "once": once}, as_json=as_json)
    elif output:
        write(bag, output, rate=rate)
        size = output.stat().st_size
        Console().print(f"view: {output} ({size / 1e6:.1f} MB)", highlight=False, soft_wrap=True)
    else:
        _show(bag, rate, viewer("serve" if web else "spawn", port))
