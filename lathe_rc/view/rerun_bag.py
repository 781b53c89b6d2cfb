# SPDX-License-Identifier: Apache-2.0
"""A bag in Rerun: logged to a recording, or written as an .rrd file."""

import os
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lathe_rc import messages
from lathe_rc.bag.reading import stream
from lathe_rc.bag.reading.source import Source, name_of
from lathe_rc.cell.beside import RERUN_RATE
from lathe_rc.cell.block import Block
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import START_NS

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


def _foresee(path: Path) -> tuple[dict[str, str], list[str], int, float, "Outlook"]:
    """Signal topics with their types, those without messages, step [ns], length [s] and outlook of a bag."""
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
        silent = [topic for topic in types if not source.topics[topic].count]
        return types, silent, step_ns, (source.last_ns - START_NS) * 1e-9, Outlook(turned, travel)


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

    types, silent, step_ns, length, outlook = _foresee(bag)
    scene = Scene(recording, types, step_ns, outlook=outlook, rate=min(rate, _POINTS / max(length, 1e-9)))
    recording.send_blueprint(blueprint(types, silent=silent))
    header = stream.feed(bag, [scene], piece=max(scene.window, _PIECE // scene.window * scene.window))
    scene.close()
    try:
        recording.flush()
    except (RuntimeError, ValueError) as error:
        raise LatheError(f"the view cannot be written ({shown(error)})") from None
    return header.samples


def write(bag: Path, output: Path, *, rate: float = RERUN_RATE) -> int:
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
    recording = rr.RecordingStream("lathe_rc", recording_id=name_of(bag))
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
