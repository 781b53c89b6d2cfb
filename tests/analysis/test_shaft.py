# SPDX-License-Identifier: Apache-2.0
"""Compliance of a shaft: against a beam of finite elements with springs, textbook beams, and limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_allclose

from lathe_machine.analysis.shaft import Shaft

LENGTH, DIAMETER = 0.6, 0.034
BENDING = 2.1e11 * np.pi * DIAMETER**4 / 64
SPRINGS = {"head": 2e7, "tail": 1e7}
stiffnesses = st.floats(1e5, 1e9)


def finite_elements(shaft, elements=12):
    """Compliance at the inner nodes: Hermite beams, exact for forces at nodes, on springs at the ends."""
    h, nodes = shaft.length / elements, elements + 1
    one = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
                    [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]])  # fmt: skip
    whole = np.zeros((2 * nodes, 2 * nodes))
    for i in range(elements):
        whole[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += shaft.bending_stiffness / h**3 * one
    whole[0, 0] += shaft.head
    if shaft.support != "chuck":
        whole[-2, -2] += shaft.tail
    if shaft.support != "centres":
        whole[1, 1] += 1 / shaft.chuck_rotation
    places = np.arange(nodes) * h
    return places, np.diag(np.linalg.inv(whole))[::2] + 1 / shaft.carriage


@given(
    st.sampled_from(["centres", "chuck_and_centre", "chuck"]), stiffnesses, stiffnesses, stiffnesses,
    st.floats(1e-7, 1e-3), st.floats(0.1, 2.0), st.floats(0.01, 0.2),
)  # fmt: skip
def test_compliance_is_that_of_finite_elements(support, head, tail, carriage, turn, length, diameter):
    turn = 0.0 if support == "centres" else turn
    shaft = Shaft(length, diameter, support, head, tail, carriage, turn)
    places, expected = finite_elements(shaft)
    assert_allclose(shaft.compliance(np.minimum(places, length)), expected, rtol=1e-5)


def test_between_centres_it_is_the_formula_of_the_task():
    z = np.linspace(0.0, LENGTH, 31)
    expected = (1 - z / LENGTH) ** 2 / 2e7 + (z / LENGTH) ** 2 / 1e7 + z**2 * (LENGTH - z) ** 2 / (3 * BENDING * LENGTH)
    assert_allclose(Shaft(LENGTH, DIAMETER, **SPRINGS).compliance(z), expected)


@pytest.mark.parametrize(
    ("support", "share", "expected"),
    [
        ("centres", 0.5, 1 / 48),
        ("chuck_and_centre", 0.5, 7 / 768),
        ("chuck_and_centre", 1.0, 0.0),
        ("chuck", 1.0, 1 / 3),
        ("chuck", 0.5, 1 / 24),
    ],
)
def test_rigid_supports_leave_the_beam_of_the_textbook(support, share, expected):
    """In L³/(E·I)."""
    compliance = Shaft(LENGTH, DIAMETER, support).compliance(share * LENGTH)
    assert_allclose(compliance * BENDING / LENGTH**3, expected, atol=1e-12)


def test_middle_of_the_example_is_as_soft_as_w3_of_the_paper():
    """The shaft of docs/force_position.md."""
    compliance = Shaft(LENGTH, DIAMETER, **SPRINGS, carriage=5e7).compliance(LENGTH / 2)
    assert float(compliance) == pytest.approx(3.85e-7, rel=0.01)


@refusals(
    (lambda: Shaft(0.0, 0.1), "shaft: length 0; allowed: above 0"),
    (lambda: Shaft(0.6, np.inf), "shaft: diameter inf"),
    (lambda: Shaft(0.6, 0.1, head=0.0), "shaft: stiffness 0 N/m of head; allowed: above 0, inf for rigid"),
    (lambda: Shaft(0.6, 0.1, "chuck", chuck_rotation=-1.0), "chuck rotation -1"),
    (lambda: Shaft(0.6, 0.1, chuck_rotation=1e-6), "between centres; a centre holds no moment"),
    (lambda: Shaft(0.6, 0.1).compliance([0.1, 0.7]), "shaft: height 0.7 m; allowed: 0 to 0.6 m"),
)
def test_what_cannot_be_is_refused(make, message):
    assert_refused(make, message)
