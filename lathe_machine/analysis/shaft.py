# SPDX-License-Identifier: Apache-2.0
"""Compliance of a shaft in the lathe along its length: deflection per unit force at the height z.

Between centres, head stock and tail stock share the force by the lever arm, and the shaft is a simply supported beam:

    1/k(z) = (1 - z/L)²/k_head + (z/L)²/k_tail + z²·(L - z)²/(3·E·I·L) + 1/k_carriage

A chuck also holds the shaft's end against tilting, so that the share of the tail stock depends on all stiffnesses. If
the tail stock carries the fraction R of a unit force and the head stock the fraction A, with the moment M at the chuck,
the principle of least energy gives

    R·(L³/(3·E·I) + 1/k_tail + 1/k_head + c·L²) = z²·(3L - z)/(6·E·I) + 1/k_head + c·z·L
    1/k(z) = z³/(3·E·I) - R·z²·(3L - z)/(6·E·I) + A/k_head + c·z·M + 1/k_carriage,  A = 1 - R,  M = z - R·L

where c is the rotation of the chuck per unit moment; c → ∞ corresponds to a centre. Without a tail stock, R = 0.

Source: paper 004, which predistorts the path of the tool for head stock, tail stock and bending of the shaft, with
models from other sources; the equations are those of elementary beam theory.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

Support = Literal["centres", "chuck_and_centre", "chuck"]

STEEL_MODULUS = 2.1e11  #: E [Pa]


@dataclass(frozen=True)
class Shaft:
    """Round shaft with its supports.

    Attributes:
        length: L, from the head stock to the tail stock, or to the free end [m].
        diameter: diameter of the shaft [m].
        support: between centres; in a chuck and the centre of the tail stock; or in a chuck alone.
        head, tail, carriage: stiffnesses of head stock, tail stock and carriage [N/m]; inf for rigid.
        chuck_rotation: c [rad/(N·m)]; 0 for a clamped end; unused between centres.
        modulus: E [Pa].

    Raises:
        InputError: a value is out of its range.
    """

    length: float
    diameter: float
    support: Support = "centres"
    head: float = np.inf
    tail: float = np.inf
    carriage: float = np.inf
    chuck_rotation: float = 0.0
    modulus: float = STEEL_MODULUS

    def __post_init__(self) -> None:
        for name in ("length", "diameter", "modulus"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise InputError(f"shaft: {name} {value:g}; allowed: above 0 and finite, in SI units")
        for name in ("head", "tail", "carriage"):
            value = getattr(self, name)
            if not value > 0.0:
                raise InputError(f"shaft: stiffness {value:g} N/m of {name}; allowed: above 0, inf for rigid")
        if not 0.0 <= self.chuck_rotation < np.inf:
            raise InputError(f"shaft: chuck rotation {self.chuck_rotation:g} rad/(N·m); allowed: 0 or more, finite")
        if self.chuck_rotation and self.support == "centres":
            raise InputError("shaft: chuck rotation between centres; a centre holds no moment, choose another support")

    @property
    def bending_stiffness(self) -> float:
        """Bending stiffness E·I of the shaft [N·m²]."""
        return self.modulus * np.pi * self.diameter**4 / 64.0

    def compliance(self, height: npt.ArrayLike) -> Array:
        """Compute the compliance 1/k(z) [m/N] at ``height`` z from the head stock [m], any shape.

        Raises:
            InputError: a height lies beyond the shaft.
        """
        z = np.asarray(height, dtype=np.float64)
        if np.any((z < 0.0) | (z > self.length)):
            wrong = z[(z < 0.0) | (z > self.length)].flat[0]
            raise InputError(f"shaft: height {wrong:g} m; allowed: 0 to {self.length:g} m")
        length, bending = self.length, self.bending_stiffness
        head, tail, turn = 1.0 / self.head, 1.0 / self.tail, self.chuck_rotation
        if self.support == "centres":
            share = z / length
            beam = z**2 * (length - z) ** 2 / (3.0 * bending * length)
            return np.asarray((1.0 - share) ** 2 * head + share**2 * tail + beam + 1.0 / self.carriage)
        lever = z**2 * (3.0 * length - z) / (6.0 * bending)
        share = np.zeros_like(z)
        if self.support == "chuck_and_centre":
            share = (lever + head + turn * z * length) / (length**3 / (3.0 * bending) + tail + head + turn * length**2)
        beam = z**3 / (3.0 * bending) - share * lever
        held = (1.0 - share) * head + turn * z * (z - share * length)
        return np.asarray(beam + held + 1.0 / self.carriage)
