# SPDX-License-Identifier: Apache-2.0
"""Rerun view of a bag: logged to a recording, or written as an .rrd file."""

import contextlib
import os
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.reading import stream
from lathe_rc.bag.reading.source import BagSource, name_of
from lathe_rc.blocks.block import Block
from lathe_rc.cell.beside import RERUN_RATE
from lathe_rc.errors import InputError, LatheError
from lathe_rc.judge.loops import ServoLoop, loops
from lathe_rc.messages import START_NS

if TYPE_CHECKING:
    import rerun as rr

    from lathe_live.rerun_scene import Scene

_PIECE = 65536  # approximate number of samples in a chunk
_END_NS = 1_000_000_000  # length of the range at the end of a bag that is searched for its last blocks
_POINTS = 300_000  # points of a curve; a long bag gets fewer per second


def _block(source: BagSource, topic: str, *, last: bool = False) -> Block | None:
    """Return the first block of a topic, or the last if it is near the end of the bag."""
    try:
        if last:
            return next(iter(deque(source.blocks(topic, start_ns=source.last_ns - _END_NS), maxlen=1)), None)
        return next(source.blocks(topic))
    except (StopIteration, LatheError) as error:
        raise InputError(f"{source.path}: {topic} has no whole block ({error})") from None


def _scene(recording: "rr.RecordingStream", path: Path, rate: float) -> "Scene":
    """Return the scene of a bag, scaled to the bag's number of revolutions and feed travel."""
    from lathe_live.rerun_part import Outlook
    from lathe_live.rerun_scene import Scene

    with BagSource(path) as source:
        types = {topic: kind.type for topic, kind in source.topics.items() if kind.type in messages.signal_types()}
        filled = {kind: t for t, kind in reversed(types.items()) if source.topics[t].count}  # first topic of each type
        first = {kind: _block(source, t) for kind, t in filled.items() if kind in messages.block_types()}
        if not first:
            raise InputError(f"{path}: nothing to show: the bag has no blocks of a cell")
        step_ns = next(block.step_ns for block in first.values() if block)
        turned = travel = 0.0
        if messages.ENCODER in first and (end := _block(source, filled[messages.ENCODER], last=True)):
            turned = float(end.signals["angle_true"][-1]) / (2.0 * np.pi)
        if (begin := first.get(messages.TOOL)) and (end := _block(source, filled[messages.TOOL], last=True)):
            travel = float(end.signals["height"][-1] - begin.signals["height"][0])
        if not step_ns or not np.isfinite([turned, travel]).all():
            raise InputError(
                f"{path}: step {step_ns} ns, {turned:g} turns, {travel:g} m along the part: not a cell's bag"
            )
        silent = [topic for topic in types if not source.topics[topic].count]
        rate = min(rate, _POINTS / max((source.last_ns - START_NS) * 1e-9, 1e-9))
        found: list[ServoLoop] = []
        with contextlib.suppress(InputError):  # a bag that does not state them shows no results of loops
            found = loops(provenance.judged(source.about))
    outlook = Outlook(turned, travel)
    return Scene(recording, types, step_ns, outlook=outlook, rate=rate, silent=silent, loops=found)


def log(recording: "rr.RecordingStream", bag: Path, *, rate: float) -> int:
    """Log a bag to a recording.

    Args:
        recording: recording with a sink; it stays open.
        bag: path of the bag.
        rate: largest number of curve points per second.

    Returns:
        Number of samples of each signal.

    Raises:
        InputError: not a bag of a cell.
        LatheError: the bag is incomplete, or the recording cannot be written.
    """
    scene = _scene(recording, bag, rate)
    # Chunks of complete windows, so that the points of the curves do not depend on the chunks.
    header = stream.feed(bag, [scene], piece=max(scene.window, _PIECE // scene.window * scene.window))
    scene.close()
    if header.loss:
        scene.note(header.samples, str(header.loss))
    return header.samples


def write(bag: Path, output: Path, *, rate: float = RERUN_RATE) -> int:
    """Write the .rrd file of a bag atomically.

    Returns:
        Number of samples of each signal.

    Raises:
        InputError: not a bag of a cell, or the file cannot be created.
        LatheError: the bag is incomplete, or the disk is full.
    """
    import rerun as rr

    if not output.parent.is_dir():
        raise InputError(f"{output}: there is no folder {output.parent}")
    recording = rr.RecordingStream("lathe_rc", recording_id=name_of(bag))
    # Rerun writes continuously. It writes under another name, so that a failure leaves an existing file unchanged.
    beside = output.with_name(f".{output.name}.{os.getpid()}")
    try:
        recording.save(beside)
        samples = log(recording, bag, rate=rate)
        recording.disconnect()
        beside.replace(output)
    except RuntimeError as error:
        raise InputError(f"{output}: cannot be written ({error})") from None
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror})") from None
    finally:
        recording.disconnect()
        beside.unlink(missing_ok=True)
    return samples
