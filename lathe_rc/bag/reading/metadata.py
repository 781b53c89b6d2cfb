# SPDX-License-Identifier: Apache-2.0
"""The file metadata.yaml of a bag's folder, of any version of rosbag2."""

import errno
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from rosbags.interfaces import Qos

from lathe_rc.bag.reading import qos
from lathe_rc.bag.reading.limits import MOST_FILES, MOST_METADATA, MOST_TEXT, MOST_TOPICS
from lathe_rc.bag.reading.precheck import check_name, read_yaml
from lathe_rc.files import contents

NAME = "metadata.yaml"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        type: message type.
        qos: offered by the publishers.
        count: messages.
    """

    type: str
    qos: tuple[Qos, ...]
    count: int


@dataclass(frozen=True)
class Metadata:
    """Content of the metadata of a bag.

    Attributes:
        files: their names, each once.
        repeated: some were named more than once.
        packed: each message is compressed by itself.
        span: first and last log time [ns]; None: no message.
        topics: by name.
        about: texts that the bag says of itself.
    """

    files: tuple[str, ...]
    repeated: bool
    packed: bool
    span: tuple[int, int] | None
    topics: Mapping[str, Topic]
    about: Mapping[str, str]


def read(folder: Path) -> Metadata:
    """Read the metadata of a folder.

    Raises:
        ValueError: they are not what rosbag2 writes, or too long.
        OSError: they cannot be read.
    """
    try:
        text = contents(folder / NAME, MOST_METADATA).decode()
    except OSError as error:
        most = f"; allowed: up to {MOST_METADATA} B" if error.errno == errno.EFBIG else ""
        raise ValueError(f"{NAME}: {error.strerror}{most}") from None
    bag = _of(read_yaml(text, NAME), "rosbag2_bagfile_information", dict)
    names = [PurePath(str(name)).name for name in _of(bag, "relative_file_paths", list)]
    files = tuple(dict.fromkeys(names))
    if len(files) > MOST_FILES or not all(files):
        raise ValueError(f"{NAME}: relative_file_paths are not up to {MOST_FILES} names of files")
    mode, form = (str(bag.get(key, "")) for key in ("compression_mode", "compression_format"))
    if mode.lower() not in ("", "none") and (mode.lower() not in ("file", "message") or form != "zstd"):
        raise ValueError(f"{NAME}: compression {form[:64]!r} by {mode[:64]!r}; allowed: zstd, by file or message")
    span = None
    if _number(_of(bag, "message_count", str)):
        first = _number(_of(_of(bag, "starting_time", dict), "nanoseconds_since_epoch", str))
        span = first, first + _number(_of(_of(bag, "duration", dict), "nanoseconds", str))
    custom = bag.get("custom_data")
    texts = custom.items() if isinstance(custom, dict) else ()
    return Metadata(
        files,
        len(files) < len(names),
        mode.lower() == "message",
        span,
        _topics(_of(bag, "topics_with_message_count", list)),
        {key[:256]: text[:MOST_TEXT] for key, text in texts if isinstance(text, str)},
    )


def _topics(listed: list[object]) -> dict[str, Topic]:
    if len(listed) > MOST_TOPICS:
        raise ValueError(f"{NAME}: {len(listed)} topics; allowed: up to {MOST_TOPICS}")
    topics: dict[str, Topic] = {}
    for each in listed:
        told = _of(each, "topic_metadata", dict)
        name, kind = told.get("name"), told.get("type")
        check_name(name)
        check_name(kind)
        offered = told.get("offered_qos_profiles", "")
        profiles = qos.of_text(offered) if isinstance(offered, str) else qos.of_list(offered)
        topics[name] = Topic(kind, profiles, _number(_of(each, "message_count", str)))
    return topics


def _of(given: object, key: str, kind: type) -> Any:
    """A part of the metadata.

    Raises:
        ValueError: it is not there, or of another kind.
    """
    part = given.get(key) if isinstance(given, dict) else None
    if not isinstance(part, kind):
        raise ValueError(f"{NAME}: no {key}, or another than rosbag2 writes")  # noqa: TRY004 - the file's fault
    return part


def _number(text: str) -> int:
    if not text.lstrip("-").isdecimal() or len(text) > len(str(2**64)):
        raise ValueError(f"{NAME}: {text[:80]!r} where a whole number belongs")
    return int(text)
