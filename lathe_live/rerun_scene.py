# SPDX-License-Identifier: Apache-2.0
"""Rerun scene of a run: part, tool, signals and learning progress, logged in columns, chunk by chunk.

The timelines are ``time``, the simulated time since sample 0, and ``revolution``, counted from 1. Memory use does not
grow with the run, but for a hundred bytes per revolution of a force or position loop.
"""

import contextlib
import io
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image

from lathe_live import rerun_part as parts
from lathe_live.rerun_blueprint import LOOP_RESULTS, LOOPS, blueprint
from lathe_live.rerun_revolutions import HIGHEST, DrawnRevolution, Revolutions
from lathe_live.rerun_signals import CYCLES, STATE_COLOURS, STATES, curve_path, curves, extreme_samples, supervisor
from lathe_rc import event_log, messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.beside import RERUN_RATE
from lathe_rc.cell.soundness import FORM, Soundness, fields_of
from lathe_rc.errors import LatheError, shown
from lathe_rc.judge.loops import ServoLoop, watches
from lathe_rc.messages import Samples, Signals, full

_POSES = 250.0  # poses of part and tool per second
_ROWS = 512  # rows of the map
_TALL = 140  # about the height of the map, for a width of 360
_LEAST = 1e-9  # smallest error of a loop that is shown, in its unit
_BARS = np.arange(1, HIGHEST + 1) - 0.5  # left edges: Rerun draws bars to the right of their position
_FLUSH, _EVER = 30.0, 1e9  # [s] allowed for a viewer to take the rest of a live recording, and for a file
_LABEL: dict[str, Any] = {"colors": (255, 255, 255), "radii": 0.1, "show_labels": True}  # readable in dark and light
_GROWTH = 8  # the map is resent when it has grown by 1/8
# Colours of Okabe and Ito, which most colour-blind people can distinguish.
_PALETTE = ((86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167), (240, 228, 66), (213, 94, 0))


class Scene:
    """Scene that logs chunks of a run; a sink of `bag.reading.stream.feed` or `lathe_live.rerun_pieces.Pieces`.

    A chunk may lack topics, and there may be gaps between chunks. The points of a curve do not depend on how the run
    is divided, provided that chunks begin at multiples of ``window``.

    Args:
        recording: recording that receives the scene.
        types: message type by topic.
        step_ns: sampling step [ns].
        outlook: properties of the whole run that are known in advance.
        rate: largest number of curve points per second.
        live: whether the view follows incoming data.
        silent: topics without messages.
        loops: force and position loops whose results are shown.

    Attributes:
        window: number of samples represented by two points of a curve.
        points: number of curve points logged so far.
        revolutions: number of revolutions logged so far.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        types: Mapping[str, str],
        step_ns: int,
        *,
        outlook: parts.Outlook | None = None,
        rate: float = RERUN_RATE,
        live: bool = False,
        silent: Collection[str] = (),
        loops: Sequence[ServoLoop] = (),
    ) -> None:
        self._loops = watches(loops, {full(topic): kind for topic, kind in types.items()})
        self._recording, self._step_ns = recording, step_ns
        self._live, self._silent = live, {full(topic) for topic in silent}
        self._types: dict[str, str] = {}
        self._nominal: set[str] = set()  # supervisors whose first state is shown
        self._conditions = event_log.Conditions()
        self._bands = False  # whether there are states; without one, their view would only say so
        self._outlook = outlook or parts.Outlook()
        self.window = max(1, int(np.ceil(2e9 / (rate * step_ns))))
        self._pose = max(1, int(np.ceil(1e9 / (_POSES * step_ns))))
        self._scale: parts.Scale | None = None
        self._revolutions = Revolutions()
        self._form: set[str] = set()  # signals that the form error is made of
        self._soundness = Soundness(self._form)
        self._ring: parts.Ring | None = None
        self._rows: list[npt.NDArray[np.uint8]] = []
        self._every = 1  # one row and one ring per this many revolutions
        self._sent = 0  # number of rows in the map sent last
        self._newest: DrawnRevolution | None = None
        self.points = self.revolutions = 0
        self.learn(types)

    def learn(self, types: Mapping[str, str]) -> None:
        """Add topics to the scene.

        Raises:
            LatheError: the recording cannot be written.
        """
        self._types |= {full(topic): kind for topic, kind in types.items()}
        self._form |= fields_of(types, FORM)
        self._curves = curves(self._types, [watch.loop for watch in self._loops])
        by_type = {kind: topic for topic, kind in reversed(self._types.items())}  # the first topic of each type
        self._encoder, self._tool = by_type.get(messages.ENCODER), by_type.get(messages.TOOL)
        self._recording.send_blueprint(self._blueprint())
        self._describe()

    def _blueprint(self) -> rrb.Blueprint:
        shown_loops = [watch.loop for watch in self._loops]
        return blueprint(self._types, live=self._live, silent=self._silent, loops=shown_loops, bands=self._bands)

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Log consecutive samples and the messages among them.

        Raises:
            LatheError: the recording cannot be written, or the spindle angle is not plausible.
        """
        self._log_nominal(first)
        named = {full(topic): signals for topic, signals in dense.items()}
        angle = named[self._encoder]["angle_true"] if self._encoder in named else None
        turns = None if angle is None else angle / (2.0 * np.pi)
        for topic, signals in named.items():
            for field, curve in self._curves.get(topic, {}).items():
                self._log_curve(curve_path(topic, field), first, signals[field] * curve.scale, turns)
        for topic, found in sparse.items():
            if found:
                self._log_messages(full(topic), found)
        for watch in self._loops:
            watch.chunk(first, samples, named, sparse)
        sound = self._soundness.sound(first, samples, sparse)
        if angle is not None and self._tool in named:
            self._log_part(first, angle, named[self._tool], sound)

    def close(self) -> None:
        """Log the remaining samples and flush the recording, which stays open.

        Raises:
            LatheError: the recording cannot be written.
        """
        self._log_revolutions(list(self._revolutions.finish()))
        if self._newest and self._sent != len(self._rows):
            self._send_map(self._newest)
        self._log_loops()
        with _write_errors():
            self._recording.flush(timeout_sec=_FLUSH if self._live else _EVER)

    def note(self, index: int, text: str) -> None:
        """Log a line of text among the events, at a sample."""
        self._send("events", rr.TextLog.columns(text=[text], level=["WARN"]), np.array([index]))

    # --- static content

    def _describe(self) -> None:
        """Log the static properties: colours, names and shapes."""
        names = {"learning/form_error/rms": "part, RMS", "learning/form_error/largest": "part, largest"}
        names |= {f"learning{t}": f"{t.strip('/')} {CYCLES[k].label}" for t, k in self._types.items() if k in CYCLES}
        plots = {"learning": list(names)}
        for topic, fields in self._curves.items():
            for field, curve in fields.items():
                path = curve_path(topic, field)
                names[path] = f"{topic.strip('/')} {curve.label}"
                plots.setdefault(curve.plot, []).append(path)
        for plot, paths in plots.items():
            for path, colour in zip(paths, itertools.cycle(_PALETTE), strict=False):
                # Rerun draws curves in the order of their paths: each is thinner than those that it could hide.
                above = len(paths) - 1 - sorted(paths).index(path)
                width = 1.5 if plot == "learning" else 1.3 + min(2.2 * above, 5.0)
                line = rr.SeriesLines(names=names[path], colors=colour, widths=width, aggregation_policy="minmax")
                self._static(path, line)
        if self._encoder and self._tool:
            self._static("machine", rr.ViewCoordinates.RIGHT_HAND_X_UP)
            self._static("machine/part/surface", rr.Mesh3D.from_fields(triangle_indices=parts.TRIANGLES))
            chuck: dict[str, Any] = {"lengths": [16.0], "radii": [1.15 * parts.RADIUS], "centers": [[0.0, 0.0, -9.0]]}
            self._static("machine/part/chuck", rr.Cylinders3D(**chuck, colors=(120, 126, 138), fill_mode="solid"))
            vertices, triangles = parts.TOOL
            insert = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=(230, 190, 60))
            self._static("machine/tool/insert", insert)
            self._send_legend()

    def _send_legend(self) -> None:
        """Log the colour scale as dots beside the part."""
        x = parts.RADIUS * parts.share(parts.SCALE)
        positions = np.stack([x, np.zeros(x.size), np.full(x.size, 1.4 * parts.LENGTH)], axis=1)
        self._static("machine/scale", rr.Points3D(positions, colors=parts.colours(parts.SCALE), radii=3.0))
        labels = [f"{deviation * 1e6:+g} µm" for deviation in parts.SCALE.tolist()]
        beside = positions + np.array([0.0, 0.0, 10.0])
        names = rr.Points3D(beside, labels=labels, **_LABEL)
        self._static("machine/scale/labels", names)

    def _static(self, path: str, what: rr.AsComponents) -> None:
        with _write_errors():
            self._recording.log(path, what, static=True, strict=True)

    # --- pieces

    def _log_nominal(self, first: int) -> None:
        """Log the nominal state of a supervisor, which sends no message until its state changes."""
        for topic, kind in self._types.items():
            if kind == messages.SAFETY_STATUS and topic not in self._nominal:
                self._nominal.add(topic)
                colours = np.array(list(STATE_COLOURS.values()), dtype=np.uint32)
                self._static(supervisor(topic), rr.StateConfiguration(values=list(STATE_COLOURS), colors=colours))
                self._log_state(supervisor(topic), next(iter(STATE_COLOURS)), first)

    def _log_curve(self, path: str, first: int, values: Samples, turns: Samples | None) -> None:
        """Log the points of a curve."""
        at = extreme_samples(values, self.window)
        self.points += at.size
        number = None if turns is None else np.floor(turns[at]) + 1
        self._send(path, rr.Scalars.columns(scalars=values[at]), first + at, number)

    def _log_messages(self, topic: str, found: list[Sparse]) -> None:
        """Log the controllers' cycle reports, and events."""
        index, kind = np.array([message.index for message in found]), found[0].type
        if kind in CYCLES:
            cycle = CYCLES[kind]
            values = parts.log_um(np.array([message.values[cycle.error] for message in found], dtype=np.float64))
            number = np.array([message.values[cycle.counter] for message in found])
            self._send(f"learning{topic}", rr.Scalars.columns(scalars=values), index, number)
        elif kind in event_log.LOGGED:
            for message in found:
                if kind == messages.SAFETY_STATUS:
                    self._log_state(supervisor(topic), event_log.supervisor_state(message), message.index)
                elif change := self._conditions.take(message):
                    self._log_state(f"{STATES}/{change[0]}", change[1], message.index)
            texts = [f"{topic.strip('/')}: {event_log.text(message)}" for message in found]
            self._send("events", rr.TextLog.columns(text=texts), index)

    def _log_part(self, first: int, angle: Samples, tool: Signals, sound: int) -> None:
        """Log the part, the tool and the form error, which rests on the first ``sound`` samples alone."""
        error, reference, height = tool["error"], tool["reference"], tool["height"]
        if self._scale is None:
            self._scale = parts.Scale.of(self._outlook, reference)
            note = [-1.95 * parts.RADIUS, 0.0, parts.LENGTH / 2]
            self._static("machine/note", rr.Points3D([note], labels=self._scale.text(), **_LABEL))
        at = np.arange(-first % self._pose, angle.size, self._pose)
        if at.size:
            turns = angle[at] / (2.0 * np.pi)
            when = first + at, np.floor(turns) + 1
            self._send("machine/part", rr.Transform3D.columns(quaternion=parts.rotations(angle[at])), *when)
            place = np.zeros((at.size, 3))
            place[:, 0] = self._scale.x((reference - error)[at])
            place[:, 2] = self._scale.z(turns, height[at])
            self._send("machine/tool", rr.Transform3D.columns(translation=place), *when)
        if sound:
            pieces = (samples[:sound] for samples in (angle, error, reference, height))
            self._log_revolutions(list(self._revolutions.add(first, *pieces)))

    # --- revolutions

    def _log_revolutions(self, complete: list[DrawnRevolution]) -> None:
        """Log rings, map rows, spectra and the learning curve of complete revolutions."""
        if not complete:
            return
        self._newest = complete[-1]
        self.revolutions += len(complete)
        for name in ("rms", "largest"):
            values = parts.log_um(np.array([getattr(revolution, name) for revolution in complete]))
            self._send(f"learning/form_error/{name}", rr.Scalars.columns(scalars=values), *_times_of(complete))
        rings: list[DrawnRevolution] = []
        strips: list[parts.Ring] = []
        for revolution in complete:
            bars = rr.BarChart.columns(values=revolution.harmonics()[1:] * 1e6, abscissa=_BARS)
            self._send("form_error/spectrum", bars, *_times_of([revolution]))
            if (revolution.number - 1) % self._every == 0:
                assert self._scale is not None
                after = parts.ring(revolution, self._scale)
                strips += [self._ring or after, after]
                self._ring = after
                rings.append(revolution)
                self._add_row(revolution)
        if rings:
            vertices, normals, colours = map(np.concatenate, zip(*strips, strict=True))
            columns = rr.Mesh3D.columns(vertex_positions=vertices, vertex_normals=normals, vertex_colors=colours)
            self._send("machine/part/surface", columns.partition([parts.STRIP] * len(rings)), *_times_of(rings))

    def _add_row(self, revolution: DrawnRevolution) -> None:
        """Add a row to the map; when the map is full, every second row is dropped."""
        self._rows.append(parts.colours(-revolution.error)[:, :3])
        # Each map is sent in full, so only after a relative growth: the total size is a multiple of the last map's.
        if len(self._rows) >= self._sent + max(1, self._sent // _GROWTH):
            self._send_map(revolution)
        if len(self._rows) == _ROWS:
            self._send_map(revolution)
            self._rows = self._rows[::2]
            self._every *= 2
            self._sent = len(self._rows)

    def _send_map(self, revolution: DrawnRevolution) -> None:
        self._sent = len(self._rows)
        image = np.stack(self._rows)
        tall, wide = max(1, _TALL // len(image)), -(-len(image) // _TALL)  # Rerun shows pixels as squares
        file = io.BytesIO()
        Image.fromarray(image.repeat(tall, axis=0).repeat(wide, axis=1)).save(file, "png")
        columns = rr.EncodedImage.columns(blob=[file.getvalue()], media_type=["image/png"])
        self._send("form_error/map", columns, *_times_of([revolution]))

    def _log_loops(self) -> None:
        """Log the errors of the force and position loops by revolution, and their verdicts and figures as text."""
        told = []
        for watch in self._loops:
            result = watch.result()
            errors, loop = result.found.errors, result.loop
            number = np.arange(errors.rms.size) + 1 + result.before
            for name, values in (("rms", errors.rms), ("largest", errors.largest)):
                path = f"{LOOPS}/{loop.node}/{name}"
                self._static(path, rr.SeriesLines(names=name, colors=_PALETTE[name == "largest"], widths=1.5))
                logarithm = np.log10(np.maximum(values * loop.quantity.scale, _LEAST))
                if number.size:
                    self._send(path, rr.Scalars.columns(scalars=logarithm), errors.starts[1:], number)
            lines = [*(text for text, _ in result.judged()), *result.behaviour()]
            told += [f"**{loop.node}**", *(f"- {line}" for line in lines), ""]
        if told:
            self._static(LOOP_RESULTS, rr.TextDocument("\n".join(told), media_type=rr.MediaType.MARKDOWN))

    # --- sending

    def _log_state(self, path: str, state: str, index: int) -> None:
        if not self._bands:
            self._bands = True
            self._recording.send_blueprint(self._blueprint())
        self._send(path, rr.StateChange.columns(state=[state]), np.array([index]))

    def _send(
        self, path: str, columns: rr.ComponentColumnList, index: Samples, revolution: Samples | None = None
    ) -> None:
        """Log columns at samples on both timelines, or only on ``time`` if the spindle angle is not known."""
        when = [rr.TimeColumn("time", duration=(index * self._step_ns).astype("timedelta64[ns]"))]
        if revolution is not None:
            when.append(rr.TimeColumn("revolution", sequence=revolution.astype(np.int64)))
        with _write_errors():
            self._recording.send_columns(path, when, columns, strict=True)


def _times_of(revolutions: list[DrawnRevolution]) -> tuple[Samples, Samples]:
    """Return the samples that follow the revolutions, and the numbers of the revolutions."""
    return np.array([each.end for each in revolutions]), np.array([each.number for each in revolutions])


@contextlib.contextmanager
def _write_errors() -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise LatheError(f"the view cannot be written ({shown(error)}); is the disk full?") from None
