# SPDX-License-Identifier: Apache-2.0
"""Every reader of files from outside, as a function of bytes that lets nothing through but what is wrong.

A reader may refuse what it is given with an error of this project, in one line; whatever else it raises is a find, and
so is a page of the report whose elements depend on texts of the bag. ``python benchmarks/fuzz.py`` runs them for long.
"""

import contextlib
import functools
import json
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from random import Random
from unittest import mock

import cells
import fuzz_mutate as mutate
import numpy as np
from bags import MODES, QOS, strange_bag
from click.testing import CliRunner
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionMode
from sealed_bags import unsealed

from lathe_bagtools.resimulation import resim
from lathe_commission import hysteresis_fit, reduced_order
from lathe_commission.commands.fit import fit as fit_command
from lathe_machine.control import memory_file
from lathe_machine.control.predistortion import Predistortion
from lathe_machine.signals import measured_profile, profile_table
from lathe_machine.stages.feed.trajectory import Trajectory, TrajectoryParameters, follow
from lathe_papers.formulas import step_fit
from lathe_rc import data_file, files, harness, messages
from lathe_rc.bag import check, provenance, reader
from lathe_rc.bag.reading import seal
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.repairing import recover
from lathe_rc.bag.writing.writer import BagWriter
from lathe_rc.blocks.wire import Encoder
from lathe_rc.cell import scenario
from lathe_rc.cell.changes import Restoring, changes
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import TABLES, Scenario, new_stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.signals import measurement_file
from lathe_rc.view import report
from lathe_rc.view.report_gather import gather
from lathe_rc.view.report_host import DIAGNOSTICS

CUT = b"\n-- cut --\n"  #: between the files of an input that stands for several
CONFIG = Path(__file__).parents[2] / "config"
_POINTS, _GRID = 64, 32
_OWN = "learning_controller"
_LONGEST_LINE = 20_000  # characters of a refusal


class NotOneLineError(AssertionError):
    """A refusal that is no line to be shown."""


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """Let the project's own errors pass, as long as each is one line."""
    try:
        yield
    except LatheError as error:
        text = str(error)
        if len(text.splitlines()) != 1 or len(text) > _LONGEST_LINE:
            raise NotOneLineError(repr(text[:500])) from error


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="lathe-fuzz-") as name:
        yield Path(name)


@dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        read: takes an input; raises what is a find.
        seeds: valid inputs.
        ways: of damaging them.
        slow: whether an input takes more than some tens of milliseconds.
    """

    read: Callable[[bytes], None]
    seeds: Callable[[], Sequence[bytes]]
    ways: Sequence[Callable[[bytes, Random], bytes]]
    slow: bool = False

    def damaged(self, random: Random) -> bytes:
        """A seed, damaged."""
        return mutate.damaged(random.choice(self.seeds()), random, self.ways)


# ---- parameter files ------------------------------------------------------------------------------------


def _parameters(data: bytes) -> None:
    with _folder() as folder, refusals():
        (folder / "fuzz.yaml").write_bytes(data)
        scenario.load(folder / "fuzz.yaml").to_yaml()


@functools.cache
def _scenarios() -> list[bytes]:
    return [path.read_bytes() for path in sorted(CONFIG.glob("*.yaml"))]


# ---- the state of a controller --------------------------------------------------------------------------


def _plain(kind: str, data: bytes) -> bytes:
    """A file of plain data whose content is damaged, not its compression or its checksum."""
    return files.sealed(f"lathe_rc {kind} 1\n".encode() + zlib.compress(data, 0))


def _content(kind: str, file: bytes) -> bytes:
    return zlib.decompress(bytes(files.unsealed(file))[len(f"lathe_rc {kind} 1\n") :])


def _state(data: bytes) -> None:
    with _folder() as folder, refusals():
        (folder / "state").write_bytes(_plain("state", data))
        stage = new_stage(_OWN, _kept().nodes[_OWN])
        data_file.read(folder / "state", "state", lambda told: Restoring().restore(told, stage))


@functools.cache
def _kept() -> Scenario:
    return scenario.load(CONFIG / "piston.yaml", ["spindle_encoder.revolutions=2"])


@functools.cache
def _states() -> list[bytes]:
    cell = Cell(_kept().nodes)
    Engine(cell).run([])
    told = changes(cell.stages[_OWN], new_stage(_OWN, _kept().nodes[_OWN]))
    return [_content("state", data_file.packed("state", told))]


# ---- tables ---------------------------------------------------------------------------------------------


def _trajectory(path: Path) -> None:
    read = Trajectory("fuzz", TrajectoryParameters(trajectory="csv", trajectory_file=str(path)))
    follow(read.course, 0, np.empty(64))


def _profile(path: Path) -> None:
    profile_table.ProfileTable(measured_profile.read_csv(path), 64).demand(100.0, 1.0, 1e-4)


_TABLES: Mapping[str, Callable[[Path], object]] = {
    "angle_deg": _profile,
    "time_s": lambda path: reduced_order.of_measurement(measurement_file.read(path)),
    "time_ms": step_fit.read_csv,
    "command_um": lambda path: hysteresis_fit.of_measurement(measurement_file.read(path)),
    "height_mm": Predistortion.load,
    "time_s,": _trajectory,
}


def _tables(data: bytes) -> None:
    with _folder() as folder, np.errstate(all="ignore"):
        (folder / "fuzz.csv").write_bytes(data)
        for read in _TABLES.values():
            with refusals():
                read(folder / "fuzz.csv")


@functools.cache
def _csv() -> list[bytes]:
    def rows(header: str, *columns: Sequence[float]) -> bytes:
        lines = [",".join(f"{value:.6g}" for value in row) for row in zip(*columns, strict=True)]
        return "\n".join([f"# a comment\n{header}", *lines, ""]).encode()

    time = np.linspace(0.0, 0.1, 24)
    loop = 10.0 * np.sin(np.linspace(0.0, 12.0, 60))
    lagging = 0.9 * loop + 0.8 * np.sign(np.gradient(loop))
    heights, angles = np.repeat([0.0, 5.0], 8), np.tile(np.arange(0.0, 360.0, 45.0), 2)
    return [
        rows("angle_deg,radius_um", angles[:8], np.sin(angles[:8])),
        rows("angle_deg,height_mm,radius_um", angles, heights, np.cos(angles)),
        rows("time_s,response", time, 1.0 - np.exp(-50.0 * time)),
        rows("time_ms,response", time * 1e3, 1.0 - np.exp(-50.0 * time)),
        rows("command_um,displacement_um", loop, lagging),
        rows("height_mm,offset_um", heights + angles / 100.0, angles),
        rows("time_s,position_um", time, time),
        rows("time_s,force_n", time, time),
    ]


def _fits(data: bytes) -> None:
    """`lathe fit` with a file that can be read."""
    with _folder() as folder, np.errstate(all="ignore"):
        (folder / "fuzz.csv").write_bytes(data)
        for command, *options in (("hysteresis",), ("channel", "--figure", str(folder / "fuzz.png"))):
            done = CliRunner().invoke(fit_command, [command, str(folder / "fuzz.csv"), *options, "--json"])
            with refusals():
                if done.exception and not isinstance(done.exception, SystemExit):
                    raise done.exception


# ---- memories -------------------------------------------------------------------------------------------


def _memory(data: bytes) -> None:
    with _folder() as folder, refusals():
        (folder / "fuzz").write_bytes(_plain("memory", data))
        points = memory_file.load(folder / "fuzz", _POINTS, _GRID)
        assert points.shape == (_POINTS,)
        assert np.isfinite(points).all()


@functools.cache
def _memories() -> list[bytes]:
    with _folder() as folder:
        memory_file.save(folder / "memory", np.linspace(-1e-5, 1e-5, _POINTS), _GRID)
        return [_content("memory", (folder / "memory").read_bytes())]


# ---- bags -----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def by_others() -> Iterator[None]:
    """Bags as of other recorders, where no seal stands before damage to the metadata."""
    with unsealed(), mock.patch.object(seal, "LIBRARY", "another"):
        yield


def make_bag(path: Path, text: str = "plain", *, compression: str = "none", blocks: int = 6) -> None:
    """A small bag with every kind of topic and ``text`` wherever a bag has texts."""
    types = messages.store().types
    about = {"lathe_rc.scenario": f"# {text}\n/**: {{}}\n", "lathe_rc.run_id": text, f"lathe_rc.{text}": text}
    about |= {"lathe_rc.versions": json.dumps({text: text}), "lathe_rc.recovered": text, "lathe_rc.name": text}
    writer = BagWriter(path, compression=compression, chunk_size=8192, about=about)  # type: ignore[arg-type]
    name = "".join(filter(str.isprintable, text))[:200]
    made = {f"/{name}/tool": messages.TOOL, f"/{name}/cut": messages.CUT, f"/{name}/encoder": messages.ENCODER}
    sparse = {
        f"/{name}/events": (messages.EVENT, {"action": text, "source": text}),
        f"/{name}/learning": (messages.LEARNING, {"source": text}),
    }
    host = f"/{name}/diagnostics"
    for topic, kind in {**made, **{topic: given[0] for topic, given in sparse.items()}, host: DIAGNOSTICS}.items():
        writer.add_topic(topic, kind, QOS)
    encoders = {topic: Encoder(kind, text, text, 15_625) for topic, kind in made.items()}
    angle = np.arange(64 * blocks) * (6.0 * np.pi / (64 * blocks))
    for number in range(blocks):
        part = angle[64 * number : 64 * (number + 1)]
        for topic, encoder in encoders.items():
            fields = messages.sample_fields(made[topic])
            waves = {field: part if "angle" in field else 1e-6 * np.sin(part) for field in fields}
            signals = {field: waves[field].astype(kind) for field, kind in fields.items()}
            stamp, data = encoder.encode(64 * number, signals, last=number == blocks - 1, companions=0)
            writer.write(topic, stamp, data)
        for topic, (kind, values) in sparse.items():
            writer.write(topic, stamp, _message(kind, 64 * number + 63, values))
        pairs = {text: text, "blocks": str(number), "samples": str(64 * number), "schedule slipped [s]": "0"}
        pairs["lost blocks"] = text
        status = types["diagnostic_msgs/msg/DiagnosticStatus"](
            2, text, text, text, [types["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in pairs.items()]
        )
        array = types[DIAGNOSTICS](messages.header(640_000 * number, 15_625), [status])
        writer.write(host, stamp, messages.encode(DIAGNOSTICS, array))
    writer.close()


def _message(kind: str, index: int, values: Mapping[str, Value]) -> bytes:
    """A sparse message with the given values, the others 0."""
    fields = {}
    for name, (node, detail) in messages.store().fielddefs[kind][1]:
        zero = "" if node == Nodetype.BASE and detail[0] == "string" else 0  # type: ignore[index]
        fields[name] = messages.header(index, 15_625) if name == "header" else values.get(name, zero)
    if "sample_index" in fields:
        fields["sample_index"] = index
    return messages.encode(kind, messages.store().types[kind](**fields))


def _read_bag(path: Path) -> None:
    """All that reads a bag but the re-simulation and the page."""
    for read in (check.check, reader.read_bag, gather, lambda bag: recover.recover(bag, bag.with_name("saved"))):
        with refusals():
            read(path)
    with refusals(), BagSource(path) as source:
        for _ in source.messages(start_ns=source.first_ns + 1):
            pass


def _mcap(data: bytes) -> None:
    with _folder() as folder, np.errstate(all="ignore"):
        (folder / "fuzz.mcap").write_bytes(data)
        _read_bag(folder / "fuzz.mcap")


@functools.cache
def _mcaps() -> list[bytes]:
    with _folder() as folder:
        for compression in ("none", "zstd"):
            make_bag(folder / compression, compression=compression)
        for mode in (CompressionMode.NONE, CompressionMode.STORAGE):
            strange_bag(folder / mode.name, mode=mode, count=20)
        return [path.read_bytes() for path in sorted(folder.glob("*/*.mcap"))]


def write_folder(path: Path, data: bytes) -> None:
    """A bag's folder from metadata, digests and storage, see `CUT`."""
    metadata, digests, storage = [*data.split(CUT, 2), b"", b""][:3]
    path.mkdir()
    (path / "metadata.yaml").write_bytes(metadata)
    if digests:
        (path / "digests.json").write_bytes(digests)
    packed = ".zstd" if storage.startswith(b"\x28\xb5\x2f\xfd") else ""
    (path / f"bag{'.db3' if b'sqlite3' in metadata else '.mcap'}{packed}").write_bytes(storage)


def _folders(data: bytes) -> None:
    with _folder() as folder, np.errstate(all="ignore"):
        write_folder(folder / "bag", data)
        _read_bag(folder / "bag")


@functools.cache
def _folder_seeds() -> list[bytes]:
    found = []
    for plugin, mode in MODES:
        with _folder() as folder:
            strange_bag(folder / "bag", plugin, mode, count=20)
            found.append(_joined(folder / "bag"))
    with _folder() as folder:
        with by_others():
            make_bag(folder / "bag")
        check.write_digests(folder / "bag", {"/plain/tool": "0" * 64})
        found.append(_joined(folder / "bag"))
    return found


def _joined(bag: Path) -> bytes:
    digests = bag / check.DIGESTS
    storage = next(path for path in sorted(bag.iterdir()) if path.name.startswith("bag."))
    parts = ((bag / "metadata.yaml").read_bytes(), digests.read_bytes() if digests.exists() else b"")
    return CUT.join([*parts, storage.read_bytes()])


def _storage(data: bytes, random: Random) -> bytes:
    """Damage to the records of the storage in a folder."""
    *head, storage = data.split(CUT, 2)
    return CUT.join([*head, mutate.some_records(storage, random)])


def _text_of_folder(data: bytes, random: Random) -> bytes:
    metadata, *rest = data.split(CUT, 2)
    return CUT.join([mutate.some_lines(metadata, random), *rest])


# ---- what a bag says of itself --------------------------------------------------------------------------


def _abouts(data: bytes) -> None:
    """Texts of a bag: the scenario, then key and text of each file."""
    first, *others = [part.decode(errors="replace") for part in data.split(CUT)]
    about = {provenance.SCENARIO: first, **dict(zip(others[::2], others[1::2], strict=False))}
    with _folder() as folder, refusals():
        (folder / "files").mkdir()
        found = provenance.scenario_of(about, folder / "files")
        for table in found.nodes.values():
            for row in type(table).rows().values():
                named = getattr(table, row.name)
                inside = not row.is_path or not named or Path(named).is_relative_to(folder / "files")
                assert inside, f"{row.name} = {named!r}: a file outside of the bag's own"


@functools.cache
def _about_seeds() -> list[bytes]:
    form = {"run_id": "r", "profile": "csv", "profile_file": str(CONFIG / "profiles" / "piston.csv")}
    tool = TABLES["tool"].read("tool", form)
    memory = {"run_id": "r", "memory_file": str(CONFIG / "memory")}
    told = Scenario("fuzz", {"tool": tool, "learning_controller": TABLES["learning_controller"].read("", memory)})
    about = provenance.tell(told, [])
    files = [part for key, text in about.items() if key.startswith(provenance.FILE) for part in (key, text)]
    seed = CUT.join(part.encode() for part in (about[provenance.SCENARIO], *files))
    return [seed, *(text + CUT + b"lathe_rc.file.tool.profile_file" + CUT + b"AAAA" for text in _scenarios())]


@functools.cache
def _turned() -> list[bytes]:
    """A run that can be simulated again."""
    made = cells.scenario(
        spindle_encoder={"revolutions": 1.2}, learning_controller={"events": ["revolution 1: freeze"]}
    )
    with _folder() as folder:
        with by_others():
            harness.run(made, bag=folder / "bag")
        return [_joined(folder / "bag")]


def _resimulated(data: bytes) -> None:
    with _folder() as folder, np.errstate(all="ignore"), refusals():
        write_folder(folder / "bag", data)
        resim.resimulate(folder / "bag")


# ---- the page -------------------------------------------------------------------------------------------


class _Elements(HTMLParser):
    """The elements of a page with the names of their attributes, in order, and where links lead."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, ...]] = []
        self.links: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take note of one."""
        self.found.append((tag, *(name for name, _ in attrs)))
        self.links += [str(value) for name, value in attrs if name in ("src", "href")]

    def handle_comment(self, data: str) -> None:
        """Comments count as elements."""
        self.found.append(("--", data))


def elements_of_page(text: str) -> list[tuple[str, ...]]:
    """The elements of the page of a bag that says ``text`` everywhere."""
    with _folder() as folder:
        make_bag(folder / "bag", text)
        told = gather(folder / "bag")
        told.forms, told.curves.signals, told.curves.cycles = [], {}, {}  # figures are images of their own
        found = _Elements(report.render(told, text, text))
    assert all(link.startswith(("data:", "#")) for link in found.links)
    return found.found


@functools.cache
def _plain_elements() -> list[tuple[str, ...]]:
    return elements_of_page("plain")


def _pages(data: bytes) -> None:
    text = "x" + data.decode(errors="replace")[:2000]  # an empty one has lines less
    with refusals():
        assert elements_of_page(text) == _plain_elements(), "the elements of the page depend on what the bag says"


def _page_seeds() -> list[bytes]:
    texts = ("<script>alert(1)</script>", "\" onload='x", "</pre><img src=x onerror=y>", "{{ 7 * 7 }}{% x %}")
    return [b"word", "".join(texts).encode(), b"<!-- x -->&lt;b&gt;]]>$\\frac{a}{b}$a/../b c"]


def _reports(data: bytes) -> None:
    """The whole page of a damaged bag, figures and all."""
    with _folder() as folder, refusals():
        (folder / "fuzz.mcap").write_bytes(data)
        report.write_report(folder / "fuzz.mcap", folder / "page.html")


TARGETS: Mapping[str, Target] = {
    "parameters": Target(_parameters, _scenarios, (mutate.some_lines,)),
    "tables": Target(_tables, _csv, (mutate.some_lines,)),
    "fits": Target(_fits, lambda: _csv()[2:5], (mutate.some_lines,), slow=True),
    "memory": Target(_memory, _memories, (mutate.some_bytes,)),
    "state": Target(_state, _states, (mutate.some_bytes,)),
    "mcap": Target(_mcap, _mcaps, (mutate.some_records, mutate.some_records, mutate.some_bytes)),
    "folder": Target(_folders, _folder_seeds, (_storage, _text_of_folder, mutate.some_bytes)),
    "about": Target(_abouts, _about_seeds, (mutate.some_lines,)),
    "page": Target(_pages, _page_seeds, (mutate.some_lines,), slow=True),
    "report": Target(_reports, _mcaps, (mutate.some_records,), slow=True),
    "resim": Target(_resimulated, _turned, (_storage, _text_of_folder), slow=True),
}  #: readers by name
