# SPDX-License-Identifier: Apache-2.0
"""Comparison of a bag's metadata and files with its seal (`lathe_rc.bag.reading.seal`)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice, zip_longest

from lathe_rc.bag.reading import metadata
from lathe_rc.bag.reading.metadata import Metadata
from lathe_rc.bag.reading.seal import FileSeal, Seal
from lathe_rc.errors import shown

_MOST_CHANGES = 1000  # maximum number listed


@dataclass
class Agreement:
    """Agreement of a bag with its seal.

    Attributes:
        seal: seal of the bag; None if no seal holds.
        metadata: the sealed metadata; without a seal, those of the bag's folder, if it has any.
        strangers: files that are not the sealed ones, or that lathe_rc wrote and that have no seal, one line each.
        changes: values in metadata.yaml that are not the sealed ones, one line each.
    """

    seal: Seal | None
    metadata: Metadata | None
    strangers: list[str] = field(default_factory=list)
    changes: list[str] = field(default_factory=list)


def compare(told: Metadata | None, files: Mapping[str, FileSeal], *, whole: bool) -> Agreement:
    """Compare a bag with its seal.

    Args:
        told: metadata of the bag's folder; None if there are none.
        files: seal of each file, by name.
        whole: whether these are all files of the bag.

    Raises:
        ValueError: the sealed metadata cannot be read.
    """
    lacking = [
        f"{name} has no seal that holds: it was changed, never closed, or recorded by an earlier version"
        for name, file in files.items()
        if file.is_lacking
    ]
    last = max((file.seal for file in files.values() if file.seal), key=lambda seal: len(seal.checksums), default=None)
    if lacking or last is None:
        return Agreement(None, told, lacking)
    if told and last.covers(told.source):
        found = Agreement(last, told)
    else:
        sealed = metadata.sealed(last.text)
        changes = _differences(told.tree, sealed.tree) if told else ()
        found = Agreement(last, sealed, changes=[*islice(changes, _MOST_CHANGES)])
    assert found.metadata is not None, "one or the other"
    # The checksum of the last file is confirmed by the seal in it.
    for name, checksum in zip(found.metadata.files, last.checksums[:-1] if whole else (), strict=False):
        if name not in files or files[name].checksum != checksum:
            found.strangers.append(f"{name} is not the file that was sealed under this name")
    return found


def _differences(told: object, sealed: object, where: str = "") -> Iterator[str]:
    """Yield the places at which the content of metadata.yaml is not the sealed one, with both values."""
    if isinstance(told, dict) and isinstance(sealed, dict):
        for key in dict.fromkeys([*sealed, *told]):
            yield from _differences(told.get(key), sealed.get(key), f"{where}.{key}" if where else str(key))
    elif isinstance(told, list) and isinstance(sealed, list):
        for number, pair in enumerate(zip_longest(told, sealed)):
            yield from _differences(*pair, f"{where}[{number}]")
    elif told != sealed:
        lines = zip_longest(_lines(told), _lines(sealed), fillvalue="")
        now, before = next((pair for pair in lines if pair[0] != pair[1]), ("", ""))
        yield f"{metadata.NAME}: {shown(where)} is {_short(told, now)}, sealed: {_short(sealed, before)}"


def _lines(value: object) -> list[str]:
    return value.splitlines() if isinstance(value, str) else []


def _short(value: object, line: str) -> str:
    return repr(line[:80]) if isinstance(value, str) else "missing" if value is None else f"a {type(value).__name__}"
