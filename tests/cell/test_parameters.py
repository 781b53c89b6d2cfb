# SPDX-License-Identifier: Apache-2.0
"""Parameter tables: what they accept, and how they refuse the rest."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from machines import line_of

from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError

WRONG = {bool: [1, "true"], int: [1.5, "1", True], float: ["1", True], str: [1, 1.5, False]}
SI = {
    "1", "m", "rad", "s", "Hz", "rad/s", "m/s", "m/s^2", "kg", "N", "N/A", "N/m", "N/s", "Pa", "V", "1/m", "1/N", "1/s",
    "1/s^2", "1/(m*s)", "1/(N*s)", "s/m", "s/N", "m/rev", "1/min", "m/s^3", "rad/s^2", "A or V", "rev", "sample",
    "block", "B", "A", "A/s", "V/s", "ohm", "H", "K", "1/K", "K*s/m", "N/m^3", "N*s/m", "N*m", "N*m/rad", "N*m*s/rad",
    "kg*m^2", "s^k",
}  # fmt: skip


def refusal(kind, name, value):
    """The one line with which a table refuses a value."""
    try:
        TABLES[kind].read("some_node", {name: value})
    except InputError as error:
        text = str(error)
    else:
        pytest.fail(f"{kind}.{name} = {value!r} is taken")
    assert len(text.splitlines()) == 1
    assert text.startswith(f"some_node.{name} = {value!r}; allowed: ")
    return text


@pytest.mark.parametrize("kind", TABLES)
def test_defaults_are_valid_and_told(kind):
    table = TABLES[kind]
    values = table.read("some_node", {})
    assert table.read("some_node", values.model_dump()) == values
    assert {name: part.default for name, part in table.rows().items()} == values.model_dump()


# All parameters of a table in one test: there are two thousand. What fails names its own.


@pytest.mark.parametrize("kind", TABLES)
def test_parameters_have_a_description_and_a_unit(kind):
    rows = TABLES[kind].rows().values()
    told = {part.name: [word for word in part.doc.split() if len(word) > 2] for part in rows}
    assert [name for name, words in told.items() if not words] == [], "a symbol alone describes nothing"
    assert {part.name: part.unit for part in rows if part.unit not in SI} == {}
    assert [part.name for part in rows if not part.allowed()] == []


def wrong_elements(part):
    """Values that a parameter, or an element of its list, does not accept, and what the refusal says of the range."""
    for value in WRONG[part.type]:
        yield value, part.allowed()
    for value in (math.nan, math.inf, -math.inf) if part.type is float else ():
        yield value, ""
    for limit, beyond in ((part.low, -1), (part.high, 1)) if part.limits else ():
        if math.isfinite(limit):
            yield part.type(limit + beyond), f" {limit:.10g}"
    if "above" in part.limits:
        yield part.type(part.low), ""
    if part.choices:
        yield "other", ", ".join(part.choices)


@pytest.mark.parametrize("kind", TABLES)
def test_wrong_types_and_values_out_of_range_are_refused_with_what_is_allowed(kind):
    for name, part in TABLES[kind].rows().items():
        for value, said in wrong_elements(part):
            assert said in refusal(kind, name, [value] if part.is_list else value)
        if part.is_list:
            refusal(kind, name, part.default[0] if part.default else 1.5)


@pytest.mark.parametrize("kind", TABLES)
def test_unknown_name_is_refused_with_those_that_look_like_it_or_with_what_lists_all(kind):
    listing = f"lathe node {kind} --help lists"
    refused = line_of(lambda: TABLES[kind].read("some_node", {"stage": kind, "nominal_rmp": 1000.0}))
    text = refused
    assert text.startswith("some_node.nominal_rmp: unknown parameter; did you mean nominal_rpm")
    assert text.endswith(f"({listing} all)")
    with pytest.raises(InputError, match=f"some_node.xyz: unknown parameter; {listing} what is allowed$"):
        TABLES[kind].read("some_node", {"stage": kind, "xyz": 1})


def test_integer_is_taken_for_a_number():
    value = NodeParameters.read("some_node", {"nominal_rpm": 1000}).nominal_rpm
    assert isinstance(value, float)


@pytest.mark.parametrize(("rate", "neighbours"), [(65_536, "64000 or 78125"), (44_100, "40000 or 50000")])
def test_rate_whose_step_is_no_whole_number_of_ns_is_refused_with_its_neighbours(rate, neighbours):
    with pytest.raises(InputError, match=f"^some_node.sample_rate = {rate} Hz: .* allowed nearby: {neighbours} Hz"):
        NodeParameters.read("some_node", {"sample_rate": rate})


@given(st.integers(1000, 1_000_000))
def test_accepted_rate_has_an_exact_step(rate):
    try:
        table = NodeParameters.read("some_node", {"sample_rate": rate})
    except InputError:
        assert 1_000_000_000 % rate
    else:
        assert table.step_ns * rate == 1_000_000_000
        assert table.step == 1 / rate


def test_speed_is_told_in_radians():
    assert NodeParameters.read("some_node", {"nominal_rpm": 1000}).nominal_speed == pytest.approx(104.72, abs=1e-3)


@pytest.mark.parametrize("run_id", ["x" * 65, "é" * 33, "two\nlines", "bell\a", "\ud800"])
def test_run_id_that_messages_cannot_carry_is_refused(run_id):
    """BlockInfo.msg bounds it to 64, and CDR counts bytes."""
    with pytest.raises(InputError, match=r"^some_node.run_id = .* at most 64 bytes$"):
        NodeParameters.read("some_node", {"run_id": run_id})
