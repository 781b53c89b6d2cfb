# SPDX-License-Identifier: Apache-2.0
"""Shapes and colours of the three-dimensional view: rings of the part, the tool, and the colour scale.

The axes are those of a lathe: Z along the spindle, X from the spindle to the tool. Lengths are in millimetres; the part
is drawn with a fixed radius, since a recording does not contain the true one.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_live import diverging
from lathe_live.panel_outlook import properties
from lathe_live.rerun_revolutions import ANGLES, DrawnRevolution
from lathe_rc.arrays import Array
from lathe_rc.cell.scenario import Scenario

#: A ring of vertices, its normals and colours, each shape (vertices, 3 or 4).
Ring = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.uint8]]

#: Deviations of the radius [m] on the scale beside the part; the outermost have the outermost colours.
SCALE = 1e-6 * np.array([-100.0, -10.0, -1.0, 0.0, 1.0, 10.0, 100.0])
_LINEAR = 0.1e-6  # form error below which the colours are linear [m]; logarithmic beyond
RADIUS = 50.0  #: radius of the part [mm]
LENGTH = 110.0  #: length of the part, if the extent of the run is known [mm]
_PITCH = 0.5  # distance between revolutions, if the extent is unknown [mm]
_DEEPEST = 0.4 * RADIUS  # largest drawn deviation [mm]
_SWING = 0.24 * RADIUS  # intended range of the drawn deviations [mm]
_LEAST = 10e-6  # lower limit of the deviations' range [m]
_STEP = 2  # one vertex per this many angles
_VERTICES = ANGLES // _STEP
_SMALLEST = 1e-9  # smallest form error that is distinguished from 0 [m]


def log_um(error: Array) -> Array:
    """Return the magnitude of an error [m] as log10 of micrometres."""
    return np.asarray(np.log10(np.maximum(np.abs(error), _SMALLEST) * 1e6))


def share(deviation: Array) -> Array:
    """Return the place of deviations of the radius [m], form errors with the other sign, in the colours, -1 to 1."""
    return np.asarray(np.sign(deviation) * np.log1p(np.abs(deviation) / _LINEAR) / np.log1p(SCALE[-1] / _LINEAR))


def colours(deviation: Array) -> npt.NDArray[np.uint8]:
    """Return RGBA colours of deviations of the radius [m], shape (n, 4), as in the report: red is material left."""
    return diverging.colours(share(deviation))


@dataclass(frozen=True)
class Outlook:
    """Properties of a run that are known before it is drawn.

    Attributes:
        revolutions: number of revolutions of the run; 0: unknown.
        travel: feed travel along the part [m]; 0: unknown, or no feed.
    """

    revolutions: float = 0.0
    travel: float = 0.0

    @classmethod
    def of(cls, scenario: Scenario) -> "Outlook":
        """Return the properties of a run of a scenario; the travel of a slide is not known in advance."""
        shown = properties(table.shown() for table in scenario.nodes.values())
        turns = shown.get("revolutions", 0.0)
        return cls(turns, turns * shown.get("feed", 0.0))


@dataclass(frozen=True)
class Scale:
    """Scale factors of the part in the view.

    Attributes:
        deviation: scale of radius deviations [mm/m].
        height: scale of heights [mm/m]; 0: revolutions are stacked instead.
        pitch: distance between stacked revolutions [mm].
    """

    deviation: float
    height: float
    pitch: float

    @classmethod
    def of(cls, outlook: Outlook, reference: Array) -> "Scale":
        """Return a scale that suits the known properties of a run and its first desired deviations [m], shape (n,)."""
        swing = float(np.ptp(reference))
        wanted = _SWING / (max(swing if np.isfinite(swing) else 0.0, _LEAST) * 1e3)
        decade = 10.0 ** np.floor(np.log10(wanted))
        exaggeration = max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= wanted * (1.0 + 1e-9))
        height = LENGTH / outlook.travel if abs(outlook.travel) > 1e-6 else 0.0
        pitch = LENGTH / max(outlook.revolutions, 10.0) if outlook.revolutions else _PITCH
        return cls(float(exaggeration) * 1e3, height, pitch)

    def z(self, turns: Array, height: Array) -> Array:
        """Return positions along the spindle [mm], from angle [revolution] and height [m]."""
        return height * self.height if self.height else turns * self.pitch

    def x(self, deviation: Array) -> Array:
        """Return distances from the spindle axis [mm], from radius deviations [m]."""
        return RADIUS + np.clip(deviation * self.deviation, -_DEEPEST, _DEEPEST)

    def text(self) -> str:
        """Return a description of the scale factors."""
        along = f"height ×{self.height / 1e3:.3g}" if self.height else "one revolution after the other"
        return f"radius deviation ×{self.deviation / 1e3:.0f}, {along}"


def ring(revolution: DrawnRevolution, scale: Scale) -> Ring:
    """Return vertices, normals and colours of the part's ring for a revolution; two rings form a strip."""
    angle = 2.0 * np.pi * (np.arange(_VERTICES) * _STEP + 0.5 * _STEP) / ANGLES
    radius = scale.x(revolution.radius.reshape(_VERTICES, _STEP).mean(axis=1))
    z = float(scale.z(np.array(revolution.number - 0.5), np.array(revolution.height)))
    cosine, sine = np.cos(angle), np.sin(angle)
    vertices = np.stack([radius * cosine, radius * sine, np.full(_VERTICES, z)], axis=1)
    slope = (np.roll(radius, -1) - np.roll(radius, 1)) / (2.0 * (angle[1] - angle[0]))
    normals = np.stack([radius * cosine + slope * sine, radius * sine - slope * cosine, np.zeros(_VERTICES)], axis=1)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    errors = revolution.error.reshape(_VERTICES, _STEP)
    largest = errors[np.arange(_VERTICES), np.abs(errors).argmax(axis=1)]
    return vertices.astype(np.float32), normals.astype(np.float32), colours(-largest)


def _triangles() -> npt.NDArray[np.uint32]:
    here = np.arange(_VERTICES)
    there = np.roll(here, -1)
    halves = [[here, there, here + _VERTICES], [there, there + _VERTICES, here + _VERTICES]]
    return np.concatenate([np.stack(half, axis=1) for half in halves]).astype(np.uint32)


TRIANGLES = _triangles()  #: triangles of a strip, shape (triangles, 3)
STRIP = 2 * _VERTICES  #: number of vertices in a strip

#: The tool with its tip at the origin: vertices [mm] and triangles.
TOOL = (
    np.array([[0, 0, 0], [14, 7, -5], [14, -7, -5], [14, -7, 5], [14, 7, 5]], dtype=np.float32),
    np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 4, 3], [1, 3, 2]], dtype=np.uint32),
)


def rotations(angle: Array) -> Array:
    """Return quaternions that rotate the point under the tool at a spindle angle [rad] to the tool, shape (n, 4)."""
    # A quaternion contains half the angle, so its period is 4π; with 2π, its sign would jump at every revolution.
    half = -0.5 * np.mod(angle, 4.0 * np.pi)
    return np.stack([np.zeros_like(half), np.zeros_like(half), np.sin(half), np.cos(half)], axis=1)
