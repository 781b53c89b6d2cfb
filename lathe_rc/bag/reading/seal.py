# SPDX-License-Identifier: Apache-2.0
"""Seal of a bag: its metadata and the checksums of its files, in the last record before the end of each file's data.

The record is the one in which rosbag2 keeps a copy of the metadata. The checksum of a file's data, which follows the
record and covers it, must result from the record and from the checksum up to the record, which the seal contains.
A change of the record, of a checksum, or of a file's place in the bag is thus found without reading the data, whose
chunks have checksums of their own. A seal has no key: it reveals accidents and edits, not forgery.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256

from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import DataEnd, Header, Metadata

from lathe_rc.bag.reading.chunk_messages import HEAD
from lathe_rc.bag.reading.sound_records import parsed

LIBRARY = "lathe_rc"  #: library that the header of each file of a bag names
RECORD = "rosbag2"  #: name of the metadata record
_TEXT, _CHECKSUMS, _DIGEST = "serialized_metadata", "lathe_rc.checksums", "lathe_rc.seal"
_SHOWN = 12  # characters of the digest that are shown


@dataclass(frozen=True)
class Seal:
    """Seal of a bag, as of the end of one of its files.

    Attributes:
        text: the bag's metadata in YAML.
        checksums: checksums of the data of all files up to this one; of this one, up to the record with the seal.
        digest: SHA-256 of the content of metadata.yaml and the checksums.
    """

    text: str
    checksums: tuple[int, ...]
    digest: str

    def __str__(self) -> str:
        """Return the beginning of the digest."""
        return self.digest[:_SHOWN]

    @property
    def record(self) -> dict[str, str]:
        """Strings of the metadata record."""
        return {_TEXT: self.text, _CHECKSUMS: _hex(self.checksums), _DIGEST: self.digest}

    def covers(self, file: bytes) -> bool:
        """Return whether the bytes are those of the sealed metadata.yaml."""
        return digest(file, self.checksums) == self.digest

    def holds(self, record: bytes, checksum: int) -> bool:
        """Return whether the content of the seal's record is what the checksum of the file's data covers."""
        return crc32(record, crc32(HEAD.pack(Opcode.METADATA, len(record)), self.checksums[-1])) == checksum


@dataclass
class FileSeal:
    """Seal of a file, from records in the order of the file.

    Attributes:
        library: library that wrote the file, as its header states.
        checksum: checksum of the file's data, as the file states it; 0 if it states none.
        seal: seal of the bag as of the end of the file; None if no seal holds.
    """

    library: str = ""
    checksum: int = 0
    seal: Seal | None = None
    _record: bytes = b""

    @property
    def is_lacking(self) -> bool:
        """Return whether lathe_rc wrote the file, but it has no seal that holds."""
        return self.library == LIBRARY and self.seal is None

    def take(self, opcode: int, content: bytes) -> None:
        """Take what a record states; records of other kinds are ignored.

        Raises:
            ValueError: the record is broken; mcap may raise other exceptions.
        """
        if opcode == Opcode.HEADER:
            self.library = parsed(Header, content).library
        elif opcode == Opcode.METADATA and parsed(Metadata, content).name == RECORD:
            self._record = content
        elif opcode == Opcode.DATA_END:
            self.checksum = parsed(DataEnd, content).data_section_crc
            found = _found(parsed(Metadata, self._record).metadata) if self._record else None
            self.seal = found if found and found.holds(self._record, self.checksum) else None


def digest(file: bytes, checksums: Sequence[int]) -> str:
    """Return the digest of the content of metadata.yaml and the checksums of the files."""
    return sha256(file + _hex(checksums).encode()).hexdigest()


def _found(strings: Mapping[str, str]) -> Seal | None:
    """Return the seal in a metadata record; None if it has none, as in bags of other recorders.

    Raises:
        ValueError: the checksums are not numbers.
    """
    if not {_TEXT, _CHECKSUMS, _DIGEST} <= strings.keys():
        return None
    sums = tuple(int(each, 16) for each in strings[_CHECKSUMS].split())
    if not sums or not all(0 <= each < 2**32 for each in sums):
        raise ValueError(f"{_CHECKSUMS} = {strings[_CHECKSUMS][:80]!r}; allowed: one of 32 bits for each file")
    return Seal(strings[_TEXT], sums, strings[_DIGEST])


def _hex(checksums: Sequence[int]) -> str:
    return " ".join(f"{each:08x}" for each in checksums)
