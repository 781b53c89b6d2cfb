# SPDX-License-Identifier: Apache-2.0
"""Which fields of a recording are drawn as curves, in what unit, and how long ones are thinned out."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc import messages
from lathe_rc.event_log import LOGGED
from lathe_rc.messages import Samples, full


@dataclass(frozen=True)
class Curve:
    """How a field is drawn.

    Attributes:
        plot: name of the plot that it belongs to.
        label: in the legend, after the name of its topic.
        scale: from the field's unit to that of the plot.
    """

    plot: str
    label: str
    scale: float


ERROR, POSITION, FORCE, SPEED, SLIDE, SERVO = "tool error", "positions", "force", "spindle speed", "slides", "servo"
PLOTS = {ERROR: "µm", POSITION: "µm", FORCE: "N", SPEED: "1/min", SLIDE: "mm", SERVO: "own units"}  #: and their units

_RPM = 60.0 / (2.0 * np.pi)
_CURVES: dict[str, dict[str, Curve]] = {
    messages.ENCODER: {"speed": Curve(SPEED, "measured", _RPM), "speed_true": Curve(SPEED, "true", _RPM)},
    messages.COMMAND: {"position": Curve(POSITION, "set", 1e6)},
    messages.STATE: {"position": Curve(POSITION, "actual", 1e6)},
    messages.TOOL: {
        "error": Curve(ERROR, "true", 1e6),
        "measured_error": Curve(ERROR, "measured", 1e6),
        "displacement": Curve(POSITION, "actual", 1e6),
        "reference": Curve(POSITION, "desired", 1e6),
    },
    messages.CUT: {"force": Curve(FORCE, "true", 1.0), "measured_force": Curve(FORCE, "measured", 1.0)},
    messages.SERVO: {"command": Curve(SERVO, "command", 1.0), "error": Curve(SERVO, "error", 1.0)},
}  # by message type and field
_SLIDE = {"position": Curve(SLIDE, "actual", 1e3)}  # of a state that a servo command belongs to


@dataclass(frozen=True)
class Cycle:
    """How controllers report a cycle: field of its error [m], field of its number, and a word for the error."""

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
}  # for the picture of the part


def curves(types: Mapping[str, str]) -> dict[str, dict[str, Curve]]:
    """The drawn curves of a recording, by fully qualified topic and field.

    Args:
        types: message type by topic.
    """
    named = {full(topic): kind for topic, kind in types.items()}
    driven = {topic.rpartition("/")[0] for topic, kind in named.items() if kind == messages.SERVO}
    found = {topic: _CURVES[kind] for topic, kind in named.items() if kind in _CURVES}
    slides = {t: _SLIDE for t, kind in named.items() if kind == messages.STATE and t.rpartition("/")[0] in driven}
    return found | slides


def wanted(msgtype: str) -> set[str]:
    """The fields of a block type that a scene uses."""
    return set(_CURVES.get(msgtype, {})) | _PART.get(msgtype, set())


def drawn(msgtype: str) -> bool:
    """Whether a scene has any use for messages of a type."""
    return bool(wanted(msgtype)) or msgtype in CYCLES or msgtype in LOGGED


def curve_path(topic: str, field: str) -> str:
    """Where a curve is in the view."""
    return f"signals{full(topic)}/{field}"


def envelope(values: Samples, window: int) -> npt.NDArray[np.intp]:
    """Places of the smallest and the largest value in every ``window`` samples, in order.

    What is drawn of a signal are then samples of it at their own times, and no peak is lost.

    Args:
        values: shape (n,).
        window: [sample]; 1 or 2 keeps everything.

    Returns:
        Indices, shape (up to 2·⌈n/window⌉,).
    """
    if window <= 2:
        return np.arange(values.size)
    whole = values.size // window * window
    pieces = [_extremes(values[:whole].reshape(-1, window), 0)]
    if whole < values.size:
        pieces.append(_extremes(values[None, whole:], whole))
    return np.concatenate(pieces)


def _extremes(rows: Samples, start: int) -> npt.NDArray[np.intp]:
    """Places of the extremes of each row, counted through all rows from ``start``."""
    if not rows.size:
        return np.empty(0, dtype=np.intp)
    low, high = rows.argmin(axis=1), rows.argmax(axis=1)
    both = np.sort(np.stack([low, high], axis=1), axis=1)
    both += start + np.arange(rows.shape[0])[:, None] * rows.shape[1]
    keep = np.ones(both.shape, dtype=bool)
    keep[:, 1] = low != high
    return np.asarray(both[keep])
