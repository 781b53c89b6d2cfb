# SPDX-License-Identifier: Apache-2.0
"""Metadata of a bag as written by any version of rosbag2: names, quality of service, and the file metadata.yaml.

The memory and time for reading metadata are bounded. Settings missing from a QoS profile count as unknown.
"""

import errno
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, TypeVar

import yaml
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from lathe_rc.bag.reading import limits
from lathe_rc.files import contents

NAME = "metadata.yaml"
_ROOT = "rosbag2_bagfile_information"

Kind = TypeVar("Kind", bound=Enum)

_YAML = getattr(yaml, "CBaseLoader", yaml.BaseLoader)  # returns strings only: no dates, no objects


@dataclass(frozen=True)
class Topic:
    """Topic listed in the metadata of a bag.

    Attributes:
        type: message type.
        qos: profiles offered by the publishers.
        count: number of messages.
    """

    type: str
    qos: tuple[Qos, ...]
    count: int


@dataclass(frozen=True)
class Metadata:
    """Content of the metadata of a bag.

    Attributes:
        files: names of the files, without duplicates.
        repeated: whether a file was listed more than once.
        packed: whether each message is compressed individually.
        span: first and last log time [ns]; None without messages.
        topics: topics by name.
        about: strings that the recorder added to the metadata.
        count: number of messages.
        counts: number of messages of each file, as far as stated.
        tree: all content, in maps, lists and strings.
        source: content of the file, in bytes; empty if the metadata are from elsewhere.
    """

    files: tuple[str, ...]
    repeated: bool
    packed: bool
    span: tuple[int, int] | None
    topics: Mapping[str, Topic]
    about: Mapping[str, str]
    count: int
    counts: Mapping[str, int]
    tree: Mapping[str, Any]
    source: bytes = b""


def read(folder: Path) -> Metadata:
    """Read the metadata of a folder.

    Raises:
        ValueError: the metadata are not in rosbag2 format, or they are too long.
        OSError: the metadata cannot be read.
    """
    try:
        source = contents(folder / NAME, limits.MOST_METADATA)
    except OSError as error:
        most = f"; allowed: up to {limits.MOST_METADATA} B" if error.errno == errno.EFBIG else ""
        raise ValueError(f"{NAME}: {error.strerror}{most}") from None
    return replace(_made(_of(read_yaml(source.decode(), NAME), _ROOT, dict)), source=source)


def sealed(text: str) -> Metadata:
    """Parse the copy of the metadata that a bag's seal contains.

    Raises:
        ValueError: see `read`.
    """
    return _made(_of({_ROOT: read_yaml(text, NAME)}, _ROOT, dict))


def _made(bag: Mapping[str, Any]) -> Metadata:
    names = [PurePath(str(name)).name for name in _of(bag, "relative_file_paths", list)]
    files = tuple(dict.fromkeys(names))
    if len(files) > limits.MOST_FILES or not all(files):
        raise ValueError(f"{NAME}: relative_file_paths are not up to {limits.MOST_FILES} names of files")
    mode, form = (str(bag.get(key, "")) for key in ("compression_mode", "compression_format"))
    if mode.lower() not in ("", "none") and (mode.lower() not in ("file", "message") or form != "zstd"):
        raise ValueError(f"{NAME}: compression {form[:64]!r} by {mode[:64]!r}; allowed: zstd, by file or message")
    span, count = None, _number(_of(bag, "message_count", str))
    if count:
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
        {key[:256]: text[: limits.MOST_TEXT] for key, text in texts if isinstance(text, str)},
        count,
        _counts(bag.get("files")),
        bag,
    )


def _counts(listed: object) -> dict[str, int]:
    """Return the number of messages of each file that the metadata state; recorders before version 5 stated none."""
    files = (each for each in listed if isinstance(each, dict)) if isinstance(listed, list) else ()
    told = ((PurePath(str(each.get("path"))).name, str(each.get("message_count"))) for each in files)
    return {name: int(count) for name, count in told if count.isdecimal() and len(count) <= len(str(2**64))}


def _topics(listed: list[object]) -> dict[str, Topic]:
    if len(listed) > limits.MOST_TOPICS:
        raise ValueError(f"{NAME}: {len(listed)} topics; allowed: up to {limits.MOST_TOPICS}")
    topics: dict[str, Topic] = {}
    for each in listed:
        told = _of(each, "topic_metadata", dict)
        name, kind = told.get("name"), told.get("type")
        check_name(name)
        check_name(kind)
        offered = told.get("offered_qos_profiles", "")
        profiles = qos_of_text(offered) if isinstance(offered, str) else qos_of_list(offered)
        topics[name] = Topic(kind, profiles, _number(_of(each, "message_count", str)))
    return topics


def _of(given: object, key: str, kind: type) -> Any:
    """Return an entry of the metadata.

    Raises:
        ValueError: the entry is missing, or of another type.
    """
    part = given.get(key) if isinstance(given, dict) else None
    if not isinstance(part, kind):
        raise ValueError(f"{NAME}: no {key}, or another than rosbag2 writes")  # noqa: TRY004 - the file's fault
    return part


def _number(text: str) -> int:
    if not text.lstrip("-").isdecimal() or len(text) > len(str(2**64)):
        raise ValueError(f"{NAME}: {text[:80]!r} where a whole number belongs")
    return int(text)


# ---- quality of service ---------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def qos_of_text(text: str) -> tuple[Qos, ...]:
    """Parse the QoS profiles of a topic's publishers from YAML; cached, since most topics have the same profiles.

    Raises:
        ValueError: the string is not YAML, or would expand when parsed.
    """
    return qos_of_list(read_yaml(text, "offered_qos_profiles"))


def qos_of_list(given: object) -> tuple[Qos, ...]:
    """Convert the QoS profiles of a topic's publishers from a list of maps, or from one map; skip anything else."""
    listed = given if isinstance(given, list) else [given]
    return tuple(_profile(each) for each in listed if isinstance(each, dict))


def _profile(given: Mapping[str, object]) -> Qos:
    deadline, lifespan, lease = (
        QosTime(_natural(part.get("sec")), _natural(part.get("nsec"))) if isinstance(part, dict) else QosTime(0, 0)
        for part in map(given.get, ("deadline", "lifespan", "liveliness_lease_duration"))
    )
    return Qos(
        _choice(QosHistory, given.get("history")),
        _natural(given.get("depth")),
        _choice(QosReliability, given.get("reliability")),
        _choice(QosDurability, given.get("durability")),
        deadline,
        lifespan,
        _choice(QosLiveliness, given.get("liveliness")),
        lease,
        avoid_ros_namespace_conventions=str(given.get("avoid_ros_namespace_conventions")).lower() == "true",
    )


def _choice(kind: type[Kind], given: object) -> Kind:
    """Return an enum member given by number (metadata up to version 8) or by name."""
    unknown: Any = kind["UNKNOWN"]
    by_number = {str(each.value): each for each in kind}
    return by_number.get(str(given)) or kind.__members__.get(str(given).upper(), unknown)


def _natural(given: object) -> int:
    """Return a natural number; 0, as if unspecified, for anything else."""
    text = str(given)
    return int(text) if text.isascii() and text.isdigit() and len(text) <= len(str(2**64)) else 0


# ---- YAML and names ------------------------------------------------------------------------------------------


def read_yaml(text: str, what: str) -> Any:
    """Parse YAML into lists, maps and strings; numbers remain strings.

    Raises:
        ValueError: see `check_yaml`; or a map key is a collection.
    """
    check_yaml(text, what)
    try:
        return yaml.load(text, Loader=_YAML)  # noqa: S506 - returns strings only
    except yaml.YAMLError as error:
        raise ValueError(f"{what}: {getattr(error, 'problem', 'not YAML')}") from None


def check_yaml(text: str, what: str) -> None:
    """Reject YAML that would expand when parsed, or take too long to parse.

    Raises:
        ValueError: the string has aliases, is nested too deeply, is too long, or is not YAML.
    """
    depth = 0
    try:
        for count, event in enumerate(yaml.parse(text, Loader=_YAML)):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"{what}: YAML aliases; ROS 2 writes none")  # noqa: TRY004 - the file's fault
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > limits.MOST_DEPTH or count > limits.MOST_EVENTS:
                raise ValueError(
                    f"{what}: nested deeper than {limits.MOST_DEPTH} or of more than {limits.MOST_EVENTS} parts"
                )
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise ValueError(f"{what}: not YAML{f' in line {mark.line + 1}' if mark else ''}") from None
    except OverflowError:
        raise ValueError(f"{what}: not YAML (a character beyond Unicode)") from None


def check_name(name: object) -> None:
    """Reject a topic or type name that cannot be shown on one line.

    Raises:
        ValueError: the name is not a string, is empty or too long, or contains unprintable characters.
    """
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= limits.LONGEST_NAME:
        raise ValueError(f"name {str(name)[:80]!r}; allowed: up to {limits.LONGEST_NAME} characters that print")
