# SPDX-License-Identifier: Apache-2.0
"""The digest of a signal topic, by which runs in different hosts are compared."""

import hashlib

import numpy as np

from lathe_rc import messages
from lathe_rc.cell.recording import Recording, SparseTopic

SIGNALS = {"angle": np.array([0.0, 0.1, 0.2]), "index_pulse": np.array([1, 0, 0], np.uint8)}


def digest(signals):
    return Recording({}, {"/encoder": signals}, {}, 1).digests()["/encoder"]


def event(index, action):
    kind = messages.store().types[messages.EVENT]
    return kind(messages.header(index, 15_625), "run", "/controller", index, action)


def digest_of_events(*events):
    topic = SparseTopic()
    for message in events:
        topic.add(messages.stamp_ns(message), message)
    return Recording({}, {}, {"/events": topic}, 1).digests()["/events"]


def combined(*fields):
    return hashlib.sha256(b"".join(hashlib.sha256(field).digest() for field in fields)).hexdigest()


def test_digest_is_the_one_of_the_design():
    """One SHA-256 for each field's samples, little-endian, then one over these."""
    assert digest(SIGNALS) == combined(SIGNALS["angle"].astype("<f8").tobytes(), b"\x01\x00\x00")


def test_byte_order_of_the_machine_leaves_no_trace():
    assert digest({**SIGNALS, "angle": SIGNALS["angle"].astype(">f8")}) == digest(SIGNALS)


def test_digest_of_events_is_of_their_stamps_and_fields_alone():
    stamps = np.array([1_000_000_000 + 5 * 15_625, 1_000_000_000 + 9 * 15_625], "<i8").tobytes()
    expected = combined(stamps, np.array([5, 9], "<i8").tobytes(), b"freeze\0clear\0")
    assert digest_of_events(event(5, "freeze"), event(9, "clear")) == expected
