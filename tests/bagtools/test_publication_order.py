# SPDX-License-Identifier: Apache-2.0
"""The order of publication and its log times, whatever the order of arrival; without ROS."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lathe_bagtools.publication_order import Continuity, PublicationOrder, Recorded
from lathe_rc.errors import LatheError

HOLD = 1000  # [ns]
BEGAN = 10**6  # [ns]

#: what was published: topic, or /clock as "", and how long after the one before [ns]
published = st.lists(st.tuples(st.sampled_from(["", "/a", "/b", "/c"]), st.integers(1, 400)), max_size=60)


def told(messages):
    """Source time, topic, number and simulated time of each message; /clock comes first."""
    source, time_ns, numbers, made = BEGAN, 7, {}, []
    for topic, later in [("", 1), *messages]:
        source += later
        numbers[topic] = numbers.get(topic, 0) + 1
        time_ns += 3 * (topic == "")
        made.append((source, topic, numbers[topic], time_ns))
    return made


def expected(made, *, sim_time=True):
    return [Recorded(t, time if sim_time else source, str(source).encode()) for source, t, _, time in made if t]


def give(order, message):
    source, topic, number, time_ns = message
    if topic:
        order.add(topic, source, number, str(source).encode())
    else:
        order.add_clock(source, number, time_ns)


def new(*, sim_time=True, hold=HOLD):
    return PublicationOrder(hold_ns=hold, sim_time=sim_time, began_ns=BEGAN)


@given(published, st.randoms(use_true_random=False), st.booleans())
def test_any_order_of_arrival_within_the_hold_gives_the_order_of_publication(messages, random, sim_time):
    made = [message for message in told(messages) if message[1] or sim_time]
    arrived = sorted(made, key=lambda message: (message[0] + random.randrange(HOLD), message[0]))
    order, written = new(sim_time=sim_time), []
    for message in arrived:
        give(order, message)
        if random.random() < 0.5:
            written += order.release(order.newest_ns)
    written += order.rest()
    assert written == expected(made, sim_time=sim_time)
    assert order.late == order.left_out == 0


def test_only_what_is_older_than_the_hold_is_given_back():
    order = new()
    give(order, (BEGAN + 1, "", 1, 7))
    give(order, (BEGAN + 2, "/a", 1, 7))
    give(order, (BEGAN + 2 + HOLD, "/b", 1, 7))
    assert list(order.release(order.newest_ns)) == []
    give(order, (BEGAN + 3 + HOLD, "/b", 2, 7))
    assert [message.topic for message in order.release(order.newest_ns)] == ["/a"]


@given(published, st.randoms(use_true_random=False))
def test_what_comes_too_late_is_counted_and_log_times_never_fall(messages, random):
    made = told(messages)
    order, written = new(hold=0), []
    newest, late = 0, 0
    for message in [made[0], *random.sample(made[1:], len(made) - 1)]:
        late += message[0] < newest
        newest = max(newest, message[0])
        give(order, message)
        written += order.release(order.newest_ns + 1)
    times = [message.log_ns for message in written]
    assert times == sorted(times)
    assert sorted(message.data for message in written) == sorted(message.data for message in expected(made))
    assert order.late == late


def test_equal_stamps_have_one_order():
    for arrival in ([("", 2), ("/a", 1), ("/b", 1)], [("/b", 1), ("/a", 1), ("", 2)]):
        order = new()
        for topic, number in arrival:
            give(order, (BEGAN + 1, topic, number, 9))
        give(order, (BEGAN, "", 1, 8))
        assert list(order.rest()) == [
            Recorded("/a", 9, str(BEGAN + 1).encode()),
            Recorded("/b", 9, str(BEGAN + 1).encode()),
        ]


@pytest.mark.parametrize(("first", "kept"), [(1, ["/latched", "/a"]), (57, ["/latched"])])
def test_before_the_first_time_heard_stands_what_was_latched_or_has_the_first_time_of_all(first, kept):
    order = new()
    give(order, (BEGAN - 5, "/latched", 1, 0))
    give(order, (BEGAN + 5, "/a", 1, 0))
    give(order, (BEGAN + 6, "", first, 0))
    assert [(message.topic, message.log_ns) for message in order.rest()] == [(topic, 0) for topic in kept]
    assert order.left_out == 2 - len(kept)


def test_a_clock_that_goes_back_or_tells_nothing_is_an_error(monkeypatch):
    order = new()
    give(order, (BEGAN + 1, "", 1, 2_000_000_000))
    give(order, (BEGAN + 2, "", 2, 1_000_000_000))
    with pytest.raises(LatheError, match=r"/clock goes back from 2\.000000000 to 1\.000000000 s"):
        list(order.rest())
    order = new()
    give(order, (BEGAN + 1, "/a", 1, 0))
    assert list(order.rest()) == []  # silence alone is no error
    with pytest.raises(LatheError, match="1 messages are not recorded"):
        order.finish()
    monkeypatch.setattr("lathe_bagtools.publication_order.MOST_EARLY", 3)
    order = new()
    give(order, (BEGAN + 1, "/a", 1, 0))
    with pytest.raises(LatheError, match="more than 3 B of messages wait"):
        list(order.rest())


@given(st.lists(st.integers(1, 30), unique=True).map(sorted), st.booleans())
def test_every_gap_of_one_publisher_is_counted(numbers, whole):
    continuity = Continuity(whole=whole)
    for number in numbers:
        continuity.take(number, lambda: 1)
    assert continuity.first == (numbers[0] if numbers else 0)
    gaps = max(numbers, default=0) - len(numbers)
    assert continuity.missing == (gaps if whole or not numbers else gaps - (numbers[0] - 1))


@given(st.lists(st.tuples(st.integers(1, 20), st.integers(1, 20)), min_size=1, max_size=4), st.randoms())
def test_publishers_that_lose_nothing_miss_nothing(spans, random):
    """Each begins somewhere and goes on without a gap; they interleave."""
    streams = [list(range(first, first + count)) for first, count in spans]
    continuity = Continuity(whole=False)
    while any(streams):
        stream = random.choice([stream for stream in streams if stream])
        continuity.take(stream.pop(0), lambda: len(spans))
    assert continuity.missing == 0


def test_a_publisher_that_comes_back_begins_again():
    continuity = Continuity(whole=True)
    for number in (1, 2, 3, 1, 2, 5):
        continuity.take(number, lambda: 1)
    assert continuity.missing == 1
