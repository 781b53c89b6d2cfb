# SPDX-License-Identifier: Apache-2.0
"""The turned part as a closed body, for STL and GLB files; the colours show the form error."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import trimesh

from lathe_rc.errors import InputError
from lathe_rc.view.diverging import colours
from lathe_rc.view.rerun_revolutions import ANGLES, Revolution

PITCH = 0.5e-3  #: distance of revolutions that lie at the same height [m]
TYPES = {"stl": "model/stl", "glb": "model/gltf-binary"}  #: media types of the files, by ending
_MM = 1e3


def body(revolutions: Sequence[Revolution], radius: float, enlarged: float, limit: float) -> trimesh.Trimesh:
    """Return the body between the first and the last revolution, in mm, with its axis along z.

    Args:
        revolutions: revolutions in order. Those that do not lie further along the part than the ones before are left
            out; if there is no feed at all, they lie `PITCH` apart.
        radius: radius from which the deviations count [m].
        enlarged: factor of the deviations.
        limit: form error of the outermost colours [m].

    Raises:
        InputError: fewer than two revolutions, or deviations that reach the axis.
    """
    heights = np.array([revolution.height for revolution in revolutions])
    if len(revolutions) > 1 and np.ptp(heights) < 1e-6:
        heights = PITCH * np.arange(len(revolutions))
    heights = np.abs(heights - heights[0]) if heights.size else heights
    further = [0, *(k for k in range(1, heights.size) if heights[k] > heights[:k].max() + 1e-9)]
    if len(further) < 2:
        raise InputError("the part has fewer than two revolutions; allowed: after the second one")
    angle = 2.0 * np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    radii = radius + enlarged * np.stack([revolutions[k].radius for k in further])
    if radii.min() <= 0.0:
        raise InputError(f"deviations × {enlarged:g} reach the axis; allowed: a smaller factor")
    z = np.broadcast_to(heights[further][:, None], radii.shape)
    rings = np.stack([radii * np.cos(angle), radii * np.sin(angle), z], axis=-1).reshape(-1, 3)
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, z[-1, 0]]])
    errors = np.stack([revolutions[k].error for k in further]).ravel()
    shades = np.concatenate([colours(-errors / limit), np.full((2, 4), 160, np.uint8)])
    return trimesh.Trimesh(
        np.concatenate([rings, ends]) * _MM, _faces(len(further)), vertex_colors=shades, process=False
    )


def _faces(rings: int) -> npt.NDArray[np.int64]:
    """Return the triangles of rings of vertices, and of two vertices on the axis after them."""
    here = np.arange(ANGLES)
    there = np.roll(here, -1)
    found = []
    for low, high in pairwise(np.arange(rings) * ANGLES):
        found.append(np.stack([low + here, low + there, high + there], axis=1))
        found.append(np.stack([low + here, high + there, high + here], axis=1))
    axis, last = rings * ANGLES, (rings - 1) * ANGLES
    found.append(np.stack([np.full(ANGLES, axis), there, here], axis=1))
    found.append(np.stack([np.full(ANGLES, axis + 1), last + here, last + there], axis=1))
    return np.concatenate(found)


def file(mesh: trimesh.Trimesh, ending: str) -> bytes:
    """Return a body as a file: STL in mm, GLB in m as glTF asks for.

    Raises:
        InputError: another ending.
    """
    if ending not in TYPES:
        raise InputError(f"format = {ending[:20]!r}; allowed: {', '.join(TYPES)}")
    if ending == "glb":
        mesh = mesh.copy()
        mesh.vertices = mesh.vertices / _MM
    found = mesh.export(file_type=ending)
    assert isinstance(found, bytes), "both formats are binary"
    return found
