# SPDX-License-Identifier: Apache-2.0
"""Encoded messages together with the publisher from which DDS has received them.

rclpy does not tell the publisher of a message, and what a message says about its sender anybody can write.
"""

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from rclpy.subscription import Subscription

GID = 16  #: bytes of an endpoint's identity that DDS assigns
_OK, _NOTHING = 0, 401  # return codes of rcl
_GID_AT = 40  # offset of the publisher's identity in an rmw_message_info_t, after four numbers and a pointer


class _Allocator(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("allocate", "free", "reallocate", "zero_allocate", "state")]


class _Message(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    ]


@cache
def _room() -> tuple[_Message, ctypes.Array[ctypes.c_uint8]]:
    """Return the memory for a message and for what DDS tells about it, which all subscriptions share."""
    made = _library("rcutils").rcutils_get_default_allocator
    made.restype = _Allocator
    return _Message(allocator=made()), (ctypes.c_uint8 * 256)()


@cache
def _library(name: str) -> ctypes.CDLL:
    """Return a library that rclpy has loaded."""
    maps = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    return ctypes.CDLL(next(line[line.index("/") :] for line in maps if f"/lib{name}.so" in line))


def taker(inlet: Subscription) -> Callable[[], tuple[bytes, bytes] | None]:
    """Return a function that takes the next encoded message of a subscription and its publisher's identity."""
    take: Any = _library("rcl").rcl_take_serialized_message
    take.argtypes = [ctypes.c_void_p] * 4
    message, about = _room()
    pointers = inlet.handle.pointer, ctypes.addressof(message), ctypes.addressof(about), None
    string_at, gid = ctypes.string_at, ctypes.addressof(about) + _GID_AT

    def call() -> tuple[bytes, bytes] | None:
        code = take(*pointers)
        if code == _OK:
            return string_at(message.buffer, message.length), string_at(gid, GID)
        if code == _NOTHING:
            return None
        raise RuntimeError(f"{inlet.topic_name}: rcl cannot take a message (code {code})")

    return call
