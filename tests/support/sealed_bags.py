# SPDX-License-Identifier: Apache-2.0
"""A sealed bag, single changes to all of it but its messages, and the verdicts of the commands that read it."""

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import Random
from unittest import mock

from bags import lathe
from cells import scenario
from mcap.opcode import Opcode
from mcap_damage import flipped, records_of

from lathe_rc import harness
from lathe_rc.bag.reading import seal
from lathe_rc.bag.repairing import recover
from lathe_rc.bag.repairing.recover import Choice
from lathe_rc.errors import LatheError
from lathe_rc.view.report import losses
from lathe_rc.view.report_gather import gather

FORM = "angle_deg,radius_um\n0,0\n120,30\n240,-10\n"
Files = Mapping[str, bytes]
_MESSAGES = (Opcode.CHUNK, Opcode.MESSAGE)
_HEAD = 9 + 8 + 8 + 8 + 4  # of a chunk, up to its compression: times, size, checksum [B]


def made(path: Path, **nodes: object) -> Path:
    """A bag of three files, of a part with a tolerance whose form is a file."""
    path.parent.mkdir(exist_ok=True)
    form = path.with_name("form.csv")
    form.write_text(FORM)
    tool = {"profile": "csv", "profile_file": str(form), "tolerance": 2e-6}
    more = {"spindle_encoder": {"revolutions": 4.0}, "tool": tool, "recorder": {"split_duration": 0.1}}
    harness.run(scenario(**more, **nodes), bag=path)  # type: ignore[arg-type]
    return path


def retold(bag: Path, change: Callable[[dict[str, str]], None]) -> None:
    """Let a bag tell other strings of itself, under a seal of its own, as its maker could have made it."""

    def about(salvages: list) -> dict[str, str]:
        told = dict(salvages[0].about)
        change(told)
        return told

    new = bag.with_name("retold") / bag.name
    new.parent.mkdir()
    recover._copied([bag], new, Choice(), about)
    for file in (*bag.glob("*.mcap"), *new.iterdir()):
        if file.parent == bag:
            file.unlink()
        else:
            file.replace(bag / file.name)
    new.rmdir()
    new.parent.rmdir()


@contextmanager
def unsealed() -> Iterator[None]:
    """Bags that are written meanwhile have no seal, and those of a maker other than lathe_rc need none."""
    plain = property(lambda sealed: {"serialized_metadata": sealed.text})
    with mock.patch.object(seal.Seal, "record", plain):
        yield


# ---- changes


def content(bag: Path) -> Files:
    """All files of a bag by name."""
    return {file.name: file.read_bytes() for file in sorted(bag.iterdir())}


def _text(data: bytes, random: Random) -> tuple[str, bytes]:
    """One bit, digit or line of a text."""
    lines, kind = data.splitlines(keepends=True), random.choice(("bit", "digit", "gone", "twice", "swapped"))
    place = random.randrange(len(lines))
    if kind == "bit":
        return kind, flipped(data, random.randrange(len(data)), 1 << random.randrange(8))
    if kind == "digit":
        return kind, _digit(data, 0, len(data), random)
    if kind == "swapped":
        other = random.randrange(len(lines))
        lines[place], lines[other] = lines[other], lines[place]
    else:
        lines[place : place + 1] = [] if kind == "gone" else [lines[place]] * 2
    return kind, b"".join(lines)


def _digit(data: bytes, begin: int, end: int, random: Random) -> bytes:
    """Another digit in place of one, if there is one."""
    digits = [match.start() for match in re.finditer(rb"[0-9]", data[begin:end])]
    if not digits:
        return data
    place = begin + random.choice(digits)
    return data[:place] + random.choice([b"%d" % k for k in range(10) if k != data[place] - 48]) + data[place + 1 :]


def _records(data: bytes, random: Random) -> tuple[str, bytes]:
    """One bit or digit of a record other than messages; each kind of record is as likely."""
    parts = [(kind, begin, begin + _HEAD if kind in _MESSAGES else end) for kind, begin, end in records_of(data)]
    kind = random.choice(sorted({part[0] for part in parts}))
    _, begin, end = random.choice([part for part in parts if part[0] == kind])
    if random.random() < 0.5:
        return f"bit in a record of kind {kind}", flipped(data, random.randrange(begin, end), 1 << random.randrange(8))
    return f"digit in a record of kind {kind}", _digit(data, begin, end, random)


def changes(files: Files, count: int, random: Random) -> Iterator[tuple[str, Files]]:
    """Single changes, as many of metadata.yaml, of digests.json and of the records."""
    for number in range(count):
        names = [[name for name in files if name.endswith(end)] for end in (".yaml", ".json", ".mcap")]
        name = random.choice(names[number % 3])
        what, data = "", files[name]
        while data == files[name]:  # a record without digits, or lines that are equal
            what, data = (_records if number % 3 == 2 else _text)(files[name], random)
        yield f"{name}: {what}", {**files, name: data}


@contextmanager
def changed(bag: Path, files: Files) -> Iterator[None]:
    """A bag with other files, for a while."""
    before = content(bag)
    _fill(bag, files)
    yield
    _fill(bag, before)


def _fill(bag: Path, files: Files) -> None:
    shutil.rmtree(bag)
    bag.mkdir()
    for name, data in files.items():
        (bag / name).write_bytes(data)


# ---- verdicts

COMMANDS = (("bag", "check"), ("bag", "info"), ("measure",), ("resim",))
_BESIDE = ("wall_s", "real_time_factor", "written", "contradictions")  # of the machine, or what a reader names


def verdicts(bag: Path, commands: Sequence[tuple[str, ...]] = COMMANDS) -> dict[str, tuple[int, object]]:
    """Exit code and figures of each reader that states a verdict; the line of one that fails."""
    found: dict[str, tuple[int, object]] = {}
    for command in commands:
        said = lathe(*command, bag, "--json")
        figures: object = said.stderr.strip()
        if not said.exit_code:
            figures = {key: value for key, value in json.loads(said.stdout).items() if key not in _BESIDE}
        found[command[-1]] = said.exit_code, figures
    try:
        gathered = gather(bag)
        judged = [repr((form.tolerances, form.verdict, form.first, form.last)) for form in gathered.forms]
        found["report"] = 3 if gathered.is_lossy else 0, (losses(gathered), judged)
    except LatheError as error:
        found["report"] = error.exit_code, str(error)
    return found


def assert_none_is_silent(bag: Path, count: int, random: Random, *commands: tuple[str, ...]) -> None:
    """After each of some changes, every reader states the verdict of before, or ends with a code of its own."""
    before = verdicts(bag, commands)
    assert not any(code for code, _ in before.values()), before
    for what, files in changes(content(bag), count, random):
        with changed(bag, files):
            for name, (code, said) in verdicts(bag, commands).items():
                assert code in (1, 2, 3) or (code, said) == before[name], (what, name, code, said)
