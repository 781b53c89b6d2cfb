# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe view``: a recorded run in Rerun."""

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import click
import numpy as np
from rich.console import Console

from lathe_rc.bag import stream
from lathe_rc.bag.source import Source
from lathe_rc.cell import messages
from lathe_rc.cell.messages import START_NS
from lathe_rc.cell.wire import Block
from lathe_rc.errors import InputError, LatheError

if TYPE_CHECKING:
    import rerun as rr

    from lathe_rc.view.rerun_part import Outlook

RATE = 2000.0  #: points of a curve in a second
_PIECE = 65536  # samples
_END_NS = 1_000_000_000  # before the end of a bag, where its last blocks are looked for
_POINTS = 300_000  # of a curve: a long bag gets fewer in a second


def require() -> None:
    """Check that Rerun is there.

    Raises:
        LatheError: it is not.
    """
    if importlib.util.find_spec("rerun_bindings") is None:
        raise LatheError("rerun is not installed; install it with: pip install rerun-sdk")
    os.environ.setdefault("RUST_LOG", "off")  # what goes wrong is told by the command


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
        raise LatheError(f"the view cannot be written ({error})") from None
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


def _show(bag: Path, rate: float, options: Sequence[str], said: str) -> None:
    """Show a bag with Rerun's own program until it ends; options are for that, ``said`` for the user."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{bag.resolve().name}.rrd"
        write(bag, file, rate=rate)
        click.echo(said)
        environment = os.environ | {"RUST_LOG": "error"}
        with contextlib.suppress(KeyboardInterrupt):
            ended = subprocess.call([sys.executable, "-m", "rerun", *options, str(file)], env=environment)
            if ended:
                raise LatheError(f"Rerun ended with code {ended}")


def _free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@click.command()
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False), help="write a .rrd file, show nothing")
@click.option("--web", is_flag=True, help="show it in a browser")
@click.option("--port", type=click.IntRange(1, 65535), default=9090, show_default=True, help="of the web page")
@click.option(
    "--rate",
    type=click.FloatRange(min=1),
    default=RATE,
    show_default=True,
    help="points of a curve in a second, at most: smallest and largest values in turn",
)
def view(bag: Path, output: Path | None, port: int, rate: float, *, web: bool) -> None:
    """Show a BAG in Rerun: the part in three dimensions, form error, signals, learning, revolution by revolution."""
    if output and web:
        raise InputError("--output with --web; allowed: one of them")
    require()
    if output:
        write(bag, output, rate=rate)
        size = output.stat().st_size
        Console().print(f"view: {output} ({size / 1e6:.1f} MB)", highlight=False, soft_wrap=True)
    elif web:
        data = _free_port()
        page = f"http://127.0.0.1:{port}/?url={quote(f'rerun+http://127.0.0.1:{data}/proxy', safe='')}"
        options = ["--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), "--port", str(data)]
        _show(bag, rate, options, f"{page}  (Ctrl-C ends it)")
    elif os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        _show(bag, rate, ["--new"], "the view opens in a window; close it to go on")
    else:
        raise InputError("no display for a window; use -o FILE.rrd or --web")
