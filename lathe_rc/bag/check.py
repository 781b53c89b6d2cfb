# SPDX-License-Identifier: Apache-2.0
"""Check that a bag has every sample once and only finite values, and is bit-identical to the recorded run."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc import files, messages
from lathe_rc.bag import provenance
from lathe_rc.bag.loss import held
from lathe_rc.bag.reading import sound_records
from lathe_rc.bag.reading.limits import SIMULATED
from lathe_rc.bag.reading.source import BagSource, files_of
from lathe_rc.bag.reading.storage import Batch
from lathe_rc.bag.snapshot import first_sample, span_of
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.wire import Decoder
from lathe_rc.cell.recording import Digester, SparseTopic
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import Samples

DIGESTS = "digests.json"  #: file in a bag's folder with the digest of each topic, written by the harness
_MOST_FINDINGS = 20  # maximum number listed per topic
_MOST_DIGESTS = 2**20  # maximum size of the digest file [B]


@dataclass
class Findings:
    """Findings of a bag check.

    Attributes:
        wrong: errors in the content, such as non-finite numbers, or digests that differ from the recorded ones.
        lost: missing content, such as gaps, or topics that end early.
        digests: digest of each signal topic, as in `lathe_rc.cell.recording`; empty if anything is wrong or lost.
        compared: number of topics whose recorded digest is identical.
        foreign: third-party code and files that the bag refers to but does not contain.
        messages: total number of messages.
        samples: number of samples of the dense topics, which all have the same length.
        first: first sample of a snapshot; 0 for a whole run.
        unread: topics that were not checked, because they are not ROS 2 topics.
        origin: bags of which the bag was made, if it was not recorded.
    """

    wrong: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)
    compared: int = 0
    foreign: list[str] = field(default_factory=list)
    messages: int = 0
    samples: int = 0
    first: int = 0
    unread: list[str] = field(default_factory=list)
    origin: list[str] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """Return 0 for a clean bag, 3 if samples are lost, or 1 if the content has errors."""
        return 1 if self.wrong else 3 if self.lost else 0


class _Sparse:
    """Check of a sparse topic, whose messages are not blocks."""

    def __init__(self, topic: str, msgtype: str, findings: Findings) -> None:
        self._topic, self._type, self._findings = topic, msgtype, findings
        self._told = 0
        self.part = SparseTopic()

    def add(self, log_ns: int, data: bytes) -> None:
        if self._told >= _MOST_FINDINGS:
            return  # no digest is computed once there are findings
        try:
            self.part.append(log_ns, messages.values_of(self._type, data))
        except ValueError as error:
            self._told += 1
            self._findings.wrong.append(f"{self._topic}: at {log_ns} ns: {shown(error)}")


class _Dense:
    """Check of a dense topic, whose messages are blocks."""

    def __init__(self, topic: str, msgtype: str, findings: Findings, digester: Digester) -> None:
        self._topic, self._findings, self._digester = topic, findings, digester
        self._decoder = Decoder(msgtype)
        self._told = 0
        self._step_ns: int | None = None
        self._run_id = ""
        self.end = findings.first
        self.ended = False

    def _tell(self, where: list[str], what: str) -> None:
        self._told += 1
        if self._told <= _MOST_FINDINGS:
            where.append(f"{self._topic}: {what}")
        elif self._told == _MOST_FINDINGS + 1:
            where.append(f"{self._topic}: and more of the kind")

    def add(self, found: Batch) -> None:
        """Check messages; consecutive blocks are checked as one."""
        start = 0
        while start < len(found):
            try:
                for block, count in self._decoder.decode_all(found.whole, found.places[start:, 2:]):
                    self._add(found.places[start : start + count, 1], block)
                    start += count
            except ValueError as error:
                self._tell(self._findings.wrong, shown(error))
                start += 1

    def _add(self, logged: Samples, block: Block) -> None:
        """Check consecutive blocks with their log times [ns], shape (blocks,)."""
        if self._step_ns is None:
            self._step_ns, self._run_id = block.step_ns, block.run_id
        if (block.step_ns, block.run_id) != (self._step_ns, self._run_id):
            self._tell(self._findings.wrong, f"another run or step from sample {block.first_index} on")
        if self.ended:
            self._tell(self._findings.wrong, f"goes on at sample {block.first_index} after its last block")
        length = block.samples // len(logged)
        later = np.arange(len(logged))[::-1] * (length * block.step_ns)
        wrong = (logged != (block.log_ns - later).astype(np.uint64)) & (logged < SIMULATED)
        for k in np.flatnonzero(wrong).tolist():  # a recorder of any topics may use the wall time
            at = block.first_index + k * length
            self._tell(self._findings.wrong, f"log time {logged[k]} ns of the block at {at}, not its stamp")
        self._sequence(block)
        self._finite(block)
        self._digester.dense(self._topic, block.signals)
        self.end, self.ended = block.first_index + block.samples, block.last

    def _sequence(self, block: Block) -> None:
        missing = block.first_index - self.end
        if missing > 0:
            self._tell(self._findings.lost, f"{missing} samples are missing before sample {block.first_index}")
        elif missing < 0:
            self._tell(self._findings.wrong, f"goes back from sample {self.end} to {block.first_index}")

    def _finite(self, block: Block) -> None:
        for name, array in block.signals.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                bad = int(np.flatnonzero(~np.isfinite(array))[0])
                self._tell(self._findings.wrong, f"{name} = {array[bad]} at sample {block.first_index + bad}")


def check(path: Path) -> Findings:
    """Check every message of a bag.

    Raises:
        InputError: the path is not a bag, or the bag is damaged and needs `lathe_rc.bag.repairing.recover`.
    """
    findings, digester = Findings(), Digester()
    with BagSource(path, altered=True) as source:
        types = {topic: said.type for topic, said in source.topics.items()}
        part, findings.first = span_of(source.about), first_sample(source.about)
        dense = {t: _Dense(t, k, findings, digester) for t, k in types.items() if k in messages.block_types()}
        sparse = {t: _Sparse(t, k, findings) for t, k in types.items() if k in messages.sparse_types()}
        counts = dict.fromkeys(types, 0)
        findings.wrong += source.altered + source.contradictions
        findings.foreign = provenance.foreign(source.about)
        findings.unread = list(map(str, source.unread))
        findings.origin = provenance.origin(source.about)
        for batch in source.batches():
            for topic in dict.fromkeys(batch.topics.values()):
                found = batch.only({topic})
                counts[topic] += len(found)
                if topic in dense:
                    dense[topic].add(found)
                for _, log_ns, data in found if topic in sparse else ():
                    sparse[topic].add(log_ns, data)
        for topic, said in source.topics.items():
            if said.count != counts[topic]:
                findings.wrong.append(f"{topic}: {counts[topic]} messages, {said.count} by the index")
        findings.messages = sum(counts.values())
    for file in files_of(path):
        findings.wrong += sound_records.damage(file) if file.suffix == ".mcap" else []
    _ends(dense, findings, part=part is not None)
    if not dense and messages.CELL_STATE in types.values():
        findings.lost.append("no block: the cell of this bag did not begin")
    if part and not 0 < part[1] == findings.samples:
        why = f"it says that it has {part[1]}" if part[1] else "it was never closed"
        findings.lost.append(f"the snapshot has {findings.samples} samples, and {why}")
    findings.lost += [
        f"{topic}: from sample {first} on its newest value, held: the node was lost"
        for topic, first in held(source.about).items()
    ]
    if loss := source.loss:
        findings.lost.append(f"samples from {loss.first} on are held or guessed, or may rest on such: {loss.why}")
    if dense and not findings.lost and not findings.wrong:
        findings.digests = digester.result({topic: looked.part for topic, looked in sparse.items()})
        _compare(path, findings)
    return findings


def _ends(dense: Mapping[str, _Dense], findings: Findings, *, part: bool) -> None:
    """Check that all dense topics end at the same sample and, in a whole run, with a block marked as the last one."""
    end = max((looked.end for looked in dense.values()), default=findings.first)
    for topic, looked in dense.items():
        if looked.end < end:
            findings.lost.append(f"{topic}: ends at sample {looked.end}, others at {end}")
        elif not looked.ended and not part:
            findings.lost.append(f"{topic}: no last block; the run went on")
    findings.samples = end - findings.first


def recorded(path: Path) -> dict[str, str]:
    """Return the digests stored in a bag's folder by the harness; empty if there are none.

    Raises:
        InputError: the file is not as it was written.
    """
    file = path / DIGESTS
    if not path.is_dir() or not file.exists():
        return {}
    try:
        content = files.contents(file, _MOST_DIGESTS)
        files.unsealed(content)
        told: Any = json.loads(content)
        return {str(topic): str(digest) for topic, digest in told["digest"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{file}: damaged or changed since the run; remove it") from None
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}; remove it") from None


def _compare(path: Path, findings: Findings) -> None:
    told = recorded(path)
    for topic in sorted(told | findings.digests) if told else ():
        if told.get(topic) != findings.digests.get(topic):
            findings.wrong.append(f"{topic}: digest {findings.digests.get(topic)}, recorded {told.get(topic)}")
        else:
            findings.compared += 1


def write_digests(path: Path, digest: Mapping[str, str]) -> None:
    """Store the digests of a run in its bag's folder.

    Raises:
        LatheError: writing to the disk fails.
    """
    try:
        with files.replacing(path / DIGESTS) as file:
            told = {"digest": dict(digest), "checksum": files.ROOM.decode()}
            file.write(files.sealed(json.dumps(told, indent=1).encode() + b"\n"))
    except OSError as error:
        raise LatheError(f"{path / DIGESTS}: cannot write ({error.strerror}); the bag is complete without") from None
