# SPDX-License-Identifier: Apache-2.0
"""Plotted parts of a recording: fields as curves, downsampled where necessary, and states as bands over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc import messages
from lathe_rc.analysis.tolerance import FORCE as NEWTONS
from lathe_rc.event_log import LOGGED
from lathe_rc.judge.loops import ServoLoop, watches
from lathe_rc.messages import Samples, full


@dataclass(frozen=True)
class Curve:
    """Plot style of a field.

    Attributes:
        plot: name of the field's plot.
        label: label in the legend, after the name of the topic.
        scale: factor from the field's unit to the plot's unit.
    """

    plot: str
    label: str
    scale: float


ERROR, POSITION, DRIVE = "tool error", "tool position", "drives"
FORCE, SPEED, SLIDE, SERVO = "force", "spindle speed", "slides", "servo"
PLOTS = {ERROR: "µm", POSITION: "µm", FORCE: "N", SPEED: "1/min", DRIVE: "µm", SLIDE: "mm"}  #: unit of each plot
PLOTS |= {SERVO: "own units"}

_RPM = 60.0 / (2.0 * np.pi)
_CURVES: dict[str, dict[str, Curve]] = {
    messages.ENCODER: {"speed": Curve(SPEED, "measured", _RPM), "speed_true": Curve(SPEED, "true", _RPM)},
    messages.COMMAND: {"position": Curve(DRIVE, "set", 1e6)},
    messages.STATE: {"position": Curve(DRIVE, "actual", 1e6)},
    messages.TOOL: {
        "error": Curve(ERROR, "true", 1e6),
        "measured_error": Curve(ERROR, "measured", 1e6),
        "reference": Curve(POSITION, "desired", 1e6),
        "displacement": Curve(POSITION, "actual", 1e6),
    },
    messages.CUT: {"force": Curve(FORCE, "true", 1.0), "measured_force": Curve(FORCE, "measured", 1.0)},
    messages.SERVO: {"command": Curve(SERVO, "command", 1.0), "error": Curve(SERVO, "error", 1.0)},
}  # by message type and field
_SLIDE = {"position": Curve(SLIDE, "actual", 1e3)}  # for a state with a servo command


@dataclass(frozen=True)
class Cycle:
    """Format of a controller's cycle reports: error field [m], number field, and a word for the error."""

    error: str
    counter: str
    label: str


CYCLES = {
    messages.LEARNING: Cycle("rms_error", "cycle", "RMS"),
    messages.PERIODIC: Cycle("max_error", "period", "largest"),
}  #: by message type

_PART = {
    messages.ENCODER: {"angle_true"},
    messages.TOOL: {"error", "reference", "height"},
}  # for the view of the part


def curves(types: Mapping[str, str], loops: Sequence[ServoLoop] = ()) -> dict[str, dict[str, Curve]]:
    """Return the plotted curves of a recording, by fully qualified topic and field.

    Args:
        types: message type by topic.
        loops: force and position loops, whose set points are drawn with what they control.
    """
    named = {full(topic): kind for topic, kind in types.items()}
    driven = {topic.rpartition("/")[0] for topic, kind in named.items() if kind == messages.SERVO}
    found = {topic: _CURVES[kind] for topic, kind in named.items() if kind in _CURVES}
    slides = {t: _SLIDE for t, kind in named.items() if kind == messages.STATE and t.rpartition("/")[0] in driven}
    for watch in watches(loops, named):
        set_point = Curve(FORCE, "set point", 1.0) if watch.loop.quantity == NEWTONS else Curve(SLIDE, "set point", 1e3)
        found[watch.topics[1]] = {**found[watch.topics[1]], "set_point": set_point}
    return found | slides


def drawn_fields(msgtype: str) -> set[str]:
    """Return the fields of a block type that a scene uses."""
    return set(_CURVES.get(msgtype, {})) | _PART.get(msgtype, set())


def is_drawn(msgtype: str) -> bool:
    """Return True if a scene uses messages of a type."""
    return bool(drawn_fields(msgtype)) or msgtype in CYCLES or msgtype in LOGGED


def curve_path(topic: str, field: str) -> str:
    """Return the entity path of a curve in the view."""
    return f"signals{full(topic)}/{field}"


def extreme_samples(values: Samples, window: int) -> npt.NDArray[np.intp]:
    """Return the indices of the smallest and the largest value in every ``window`` samples, in order.

    A curve through these samples keeps their original times and loses no peak.

    Args:
        values: samples of a signal, shape (n,).
        window: length [sample]; 1 or 2 keeps all samples.

    Returns:
        Indices, shape (up to 2·⌈n/window⌉,).
    """
    if window <= 2 or not values.size:
        return np.arange(values.size)
    # Padding repeats the last value; argmin and argmax return the first of equal values, so never a padded index.
    rows = np.pad(values, (0, -values.size % window), mode="edge").reshape(-1, window)
    ends = np.sort([rows.argmin(axis=1), rows.argmax(axis=1)], axis=0)
    keep = np.stack([np.ones(len(rows), dtype=bool), ends[0] != ends[1]], axis=1)
    return np.asarray((ends + np.arange(len(rows)) * window).T[keep])


# --- bands

STATES = "states"  #: entity path of the bands in the view
#: Colours of the supervisor's states.
STATE_COLOURS = {"nominal": 0x2E7D4FFF, "degraded": 0xB8860BFF, "retracting": 0xD2622AFF, "safe": 0xB3262EFF}


def supervisor(topic: str) -> str:
    """Return the entity path of a supervisor's band, given the topic of its status."""
    return f"{STATES}/cell{full(topic).removesuffix('/status')}"
