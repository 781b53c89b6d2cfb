# SPDX-License-Identifier: Apache-2.0
"""Scenarios: ROS 2 parameter files that describe a whole cell."""

import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar, cast

import yaml

from lathe_rc import allowed_code, files, resources
from lathe_rc.cell import models, ros_yaml
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.parameters import NodeParameters, ParameterRow, SharedParameters, Value, Values
from lathe_rc.cell.recorder import KIND as RECORDER
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.time_master import TimeMasterParameters
from lathe_rc.drawing import html
from lathe_rc.errors import InputError, shown
from lathe_rc.extensions import in_words
from lathe_rc.names import instead

Table = TypeVar("Table", bound=NodeParameters)


class _Tables(Mapping[str, type[NodeParameters]]):
    """Parameter tables by kind of node, including third-party kinds (see `lathe_rc.extensions.Registry`)."""

    @property
    def own(self) -> list[str]:
        """Built-in kinds."""
        return [*STAGES.own, RECORDER]

    def allowed(self) -> str:
        """Return the list of kinds in words."""
        return in_words(self)

    def instead(self, kind: str) -> str:
        """Return the kinds similar to an unknown one, or all of them, in words."""
        return f"{instead(kind, self)} (others: PACKAGE.MODULE:CLASS)"

    def __iter__(self) -> Iterator[str]:
        yield from STAGES
        yield RECORDER

    def __len__(self) -> int:
        return len(STAGES) + 1

    def __getitem__(self, kind: str) -> type[NodeParameters]:
        return RecorderParameters if kind == RECORDER else STAGES[kind].Parameters


TABLES = _Tables()

_EVERYONE = "/**"
_ROS = "ros__parameters"
_ELEMENT = re.compile(r"(.*\S)\[(\d+)\]")
# Parameters that affect neither the samples nor the messages of a run, and therefore not its identity.
HOST_PARAMETERS = {
    *("run_id", "speed_factor", "strict_pace", "simulation_services", "window", "members", "processes", "autostart"),
    *("stall_reaction", "stall_time", "safe_time", "restart_time", "restart_file"),
}


def kind_of(node: str, stage: object) -> str:
    """Return the kind of a node: its ``stage`` parameter, or its name.

    Raises:
        InputError: there is no such stage.
    """
    kind = str(stage or node)
    if kind not in TABLES:
        raise InputError(f"{node}: no stage {shown(kind)!r}; {TABLES.instead(kind)}; set {node}.stage")
    return kind


def new_stage(name: str, table: NodeParameters) -> Stage:
    """Create the stage of a node."""
    return STAGES[kind_of(name, table.stage)](name, table)


class _Text(str):
    """String that is written in quotes: without them, rcl reads 1e-3 as a number and y as true, unlike PyYAML."""

    __slots__ = ()


_TEXT = "tag:yaml.org,2002:str"


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]  # absent without libyaml
    """YAML dumper whose output rcl reads back as the same values."""


_Dumper.add_representer(_Text, lambda dumper, text: dumper.represent_scalar(_TEXT, str(text), style='"'))


def _quoted(value: Value) -> object:
    if isinstance(value, list):
        return [_quoted(item) for item in value]
    return _Text(value) if isinstance(value, str) else value


@dataclass(frozen=True, repr=False)
class Scenario:
    """Description of a cell; see `load` and `varied` for examples.

    Attributes:
        name: name of the file without its extension.
        nodes: parameter table of each node by node name, in the order of the file.
        fingerprints: hashes of the tables by node, as far as computed; the run ID is derived from them.
    """

    name: str
    nodes: dict[str, NodeParameters]
    fingerprints: Mapping[str, str] = field(default_factory=dict, compare=False)

    def __repr__(self) -> str:
        """Return the scenario name and its nodes in one line."""
        return f"<Scenario {self.name}: {', '.join(self.nodes)}>"

    def _repr_html_(self) -> str:
        """Return an HTML table of the nodes and their non-default parameters, for notebooks."""
        shared = SharedParameters.model_fields
        rows = [("all nodes", "", self.shared.other_than_default(shared))] if self.nodes else []
        for node, table in self.nodes.items():
            own = table.other_than_default(table.rows().keys() - shared.keys())
            rows.append((node, self.kind(node) if table.stage else "", own))
        return html.table((self.name, "kind", "other than default"), rows)

    @property
    def shared(self) -> SharedParameters:
        """Parameters shared by all nodes."""
        return next(iter(self.nodes.values()))

    def kind(self, node: str) -> str:
        """Return the kind of a node."""
        return kind_of(node, self.nodes[node].stage)

    def of_kind(self, kind: str) -> list[str]:
        """Return the names of the nodes of a kind."""
        return [name for name in self.nodes if self.kind(name) == kind]

    def first(self, kind: type[Table]) -> Table | None:
        """Return the first parameter table of a class; None if there is none."""
        return next((table for table in self.nodes.values() if isinstance(table, kind)), None)

    @property
    def masters(self) -> list[str]:
        """Names of the time masters; exactly one in a valid cell."""
        return [name for name, table in self.nodes.items() if isinstance(table, TimeMasterParameters)]

    def check_members(self) -> None:
        """Check that a time master names nodes of the scenario as members; a recorder may be added to them.

        Raises:
            InputError: a member does not exist.
        """
        known = dict.fromkeys([*self.nodes, self.recorder[0]])
        for master in self.masters:
            for name in getattr(self.nodes[master], "members", []):
                if name.rpartition("/")[2] not in known:
                    what = f"{master}.members: no node {shown(name)!r} in the scenario"
                    raise InputError(f"{what}; {instead(name, [each for each in known if each != master])}")

    @property
    def recorder(self) -> tuple[str, RecorderParameters]:
        """Name and table of the recorder; default values if the scenario has none."""
        for name, table in self.nodes.items():
            if isinstance(table, RecorderParameters):
                return name, table
        shared = {name: getattr(self.shared, name) for name in SharedParameters.model_fields}
        return RECORDER, RecorderParameters(**shared)

    def processes(self, groups: Iterable[Iterable[str]] | None = None, what: str = "processes") -> list[list[str]]:
        """Return the names of the nodes in each process.

        Args:
            groups: nodes that share a process; None: the groups in the time master's ``processes``. Every other
                node has a process of its own.
            what: name of the groups in error messages.

        Raises:
            InputError: a node does not exist, or is listed twice.
        """
        if groups is None:
            named = [(node, text) for node, table in self.nodes.items() for text in getattr(table, "processes", [])]
            what = f"{named[0][0]}.processes" if named else what
            groups = [text.split("+") for _, text in named]
        split = [[name.strip() for name in group] for group in groups]
        seen: set[str] = set()
        for name in (name for group in split for name in group):
            if name not in self.nodes:
                raise InputError(f"{what}: no node {shown(name)!r} in the scenario; {instead(name, self.nodes)}")
            if name in seen:
                raise InputError(f"{what}: {name} is named twice; allowed: each node in one process")
            seen.add(name)
        return split + [[name] for name in self.nodes if name not in seen]

    @property
    def identity(self) -> str:
        """Hash of everything that affects a run: nodes, parameters, and contents of referenced files."""
        missing = {node: table for node, table in self.nodes.items() if node not in self.fingerprints}
        return _hash({**self.fingerprints, **{node: _fingerprint(table) for node, table in missing.items()}})

    @cached_property
    def _has_own_run_id(self) -> bool:
        """Whether the run ID is derived from the content instead of being set explicitly."""
        return self.shared.run_id == _identity(self.fingerprints)

    def parameter(self, target: str) -> ParameterRow:
        """Return the row of a parameter in its node's table.

        Args:
            target: ``NODE.PARAM``, or ``PARAM`` for a shared parameter, with ``[K]`` for an element of a list.

        Raises:
            InputError: there is no such parameter.
        """
        kinds = {node: self.kind(node) for node in self.nodes}
        whole, element = _element(target)
        node, name = _target(whole, kinds, shown(target))
        rows = SharedParameters.rows() if node == _EVERYONE else TABLES[kinds[node]].rows()
        if name not in rows:
            known = instead(name, sorted(rows), listing=NodeParameters.listing.format(kinds[node]))
            raise InputError(f"{shown(target)}: unknown parameter; {known}")
        if element is None:
            return rows[name]
        _with_element(target, getattr(self.nodes[node], name), element, 0.0)
        return rows[name].element()

    def value(self, target: str) -> Value:
        """Return the value of a parameter (``target`` as in `parameter`)."""
        whole, element = _element(target)
        node, _, name = whole.rpartition(".")
        found = getattr(self.nodes[node] if node else self.shared, name)
        return cast("Value", found if element is None else found[element])

    def follows(self, target: str) -> bool:
        """Return whether a parameter takes its value from other nodes (``target`` as in `parameter`)."""
        node, _, name = _element(target)[0].rpartition(".")
        return bool(node) and models.follows(self.nodes[node], name)

    def named(self) -> "Scenario":
        """Return the same cell with a fixed run ID, which its variations keep."""
        return self.varied({"run_id": f"{self.shared.run_id} varied"})

    def with_models_given(self) -> "Scenario":
        """Return the same cell with fixed drive models in the controllers, which do not change with the drives."""
        tables = {node: models.given(table) for node, table in self.nodes.items()}
        return Scenario(self.name, tables, self.fingerprints)

    def varied(self, values: Values) -> "Scenario":
        """Return the same cell with other parameter values, without reading its file again.

        Args:
            values: new values by ``NODE.PARAM``, or ``PARAM`` for a shared parameter; ``NODE.PARAM[K]`` is element K of
                a list.

        Raises:
            InputError: the input is invalid; the one-line message describes the first error.

        Example:
            >>> import lathe_rc
            >>> piston = lathe_rc.load("piston")
            >>> shorter = piston.varied({"learning_controller.lead_time": 1.3e-3, "block_size": 128})
            >>> piston.nodes["learning_controller"].lead_time, shorter.nodes["learning_controller"].lead_time
            (0.001425, 0.0013)
            >>> {table.block_size for table in shorter.nodes.values()}
            {128}
            >>> piston.varied({"learning_controller.lead_tim": 1.3e-3})
            Traceback (most recent call last):
            lathe_rc.errors.InputError: learning_controller.lead_tim: unknown parameter; did you mean lead_time, ...
        """
        changes: dict[str, dict[str, Value]] = {}
        kinds = {node: self.kind(node) for node in self.nodes}
        for target, value in values.items():
            whole, element = _element(target)
            node, name = _target(whole, kinds, target)
            for each in [node] if node != _EVERYONE else self.nodes:
                found = changes.setdefault(each, {})
                given_value = _of_user(kinds[each], name, value, Path())
                if element is not None:
                    before = found.get(name, getattr(self.nodes[each], name, None))
                    found[name] = _with_element(target, before, element, given_value)
                else:
                    found[name] = given_value
        tables = dict(self.nodes)
        for node, changed in changes.items():
            tables[node] = self.nodes[node].changed(node, changed)
        return self._with(tables, given="run_id" in values or not self._has_own_run_id)

    def with_node(self, node: str, table: NodeParameters) -> "Scenario":
        """Return the same cell with another table of a node, whose kind may differ."""
        return self._with({**self.nodes, node: table}, given=not self._has_own_run_id)

    def _with(self, tables: Mapping[str, NodeParameters], *, given: bool) -> "Scenario":
        """Return the cell with other tables; ``given``: whether its run id is set explicitly."""
        # A changed drive changes the models of its controllers, unless these are given.
        tables = models.resolved(tables)
        other = {node: table for node, table in tables.items() if table is not self.nodes[node]}
        if given and (run_id := next(iter(tables.values())).run_id):
            # With a given run ID, changed tables are hashed only when the identity is requested.
            known = {node: told for node, told in self.fingerprints.items() if node not in other}
            return _agreed(self.name, tables, known, run_id)
        fingerprints = {**self.fingerprints, **{node: _fingerprint(table) for node, table in other.items()}}
        return _agreed(self.name, tables, fingerprints, _identity(fingerprints))

    def to_yaml(self, *, given: bool = False) -> str:
        """Return the parameter file; empty lists are left out, since rcl cannot read them.

        Args:
            given: whether to write only the values that are set explicitly; when the file is read, the others take
                their defaults, and models follow their drives.
        """
        tree = {}
        # A run ID derived from the content would be wrong as soon as a reader changes a value.
        left_out = {"run_id"} if given and self._has_own_run_id else None
        for name, table in self.nodes.items():
            kept = table.model_dump(exclude_unset=given, exclude=left_out)
            rows = type(table).rows()
            # An empty model of a drive is a choice: without it the model would follow the drive.
            values = {key: _quoted(value) for key, value in kept.items() if value != [] or (given and rows[key].drive)}
            tree[f"/**/{name}"] = {_ROS: values}
        return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, default_flow_style=None)


def differences(one: Scenario, other: Scenario) -> list[str]:
    """Return the differences between two cells, as given, in words."""
    trees = [yaml.safe_load(each.to_yaml(given=True)) for each in (one, other)]
    there, here = (
        {
            name if name in SharedParameters.model_fields else f"{node.removeprefix('/**/')}.{name}": value
            for node, table in tree.items()
            for name, value in table[_ROS].items()
        }
        for tree in trees
    )
    return [
        f"{name} = {shown(there.get(name, 'default'))} there, and {shown(here.get(name, 'default'))} here"
        for name in dict.fromkeys([*there, *here])
        if there.get(name) != here.get(name)
    ]


def _element(target: str) -> tuple[str, int | None]:
    """Split a target into the part before ``[K]``, and K."""
    match = _ELEMENT.fullmatch(target.strip())
    return (match[1], int(match[2])) if match else (target, None)


def _with_element(target: str, values: object, element: int, value: Value) -> Value:
    """Return a list with one element replaced.

    Raises:
        InputError: the list has no such element.
    """
    if not isinstance(values, list) or element >= len(values):
        has = f"a list of {len(values)}" if isinstance(values, list) else "no list"
        raise InputError(f"{shown(target)}: the scenario has {has} there; allowed: an element of a list")
    return cast("Value", [*values[:element], value, *values[element + 1 :]])


def _target(text: str, kinds: Mapping[str, str], what: str) -> tuple[str, str]:
    """Return the node and the parameter of ``NODE.PARAM`` or, for a shared parameter, ``PARAM``.

    Args:
        text: target to be split.
        kinds: kinds of the nodes, by name.
        what: name of the target in error messages.

    Raises:
        InputError: there is no such node, or the parameter is not shared.
    """
    node, dot, name = text.strip().partition(".")
    if not dot:
        if node not in SharedParameters.model_fields:
            owners = [owner for owner, kind in kinds.items() if node in TABLES[kind].model_fields]
            known = f"did you mean {' or '.join(f'{owner}.{node}' for owner in owners[:3])}?" if owners else ""
            known = known or f"not NODE.PARAM=VALUE either; {instead(node, SharedParameters.model_fields)}"
            raise InputError(f"{what}: {node!r} is not shared; {known}")
        return _EVERYONE, node
    if node not in kinds:
        raise InputError(f"{what}: no node {node!r} in the scenario; {instead(node, kinds)}")
    return node, name


def _override(text: str, nodes: dict[str, dict[str, Value]]) -> tuple[str, str]:
    """Apply ``NODE.PARAM=VALUE`` or, for a shared parameter, ``PARAM=VALUE``; return the node and the parameter."""
    target, equals, value = text.partition("=")
    if not equals:
        raise InputError(f"--set {text!r}; allowed: NODE.PARAM=VALUE, or PARAM=VALUE for a shared parameter")
    kinds = {name: kind_of(name, own.get("stage")) for name, own in nodes.items() if name != _EVERYONE}
    node, name = _target(target, kinds, f"--set {text!r}")
    parsed = ros_yaml.parse_value(value, f"--set {shown(target)}")
    if node == _EVERYONE:
        for values in nodes.values():
            # A node's own value would conflict with the shared one.
            values.pop(name, None)
        nodes.setdefault(node, {})[name] = parsed
    else:
        nodes[node][name] = _of_user(kinds[node], name, parsed, Path())
    return node, name


def _of_user(kind: str, name: str, value: Value, folder: Path) -> Value:
    """Convert a user's value: make a path relative to ``folder`` absolute, and allow the code that the value names."""
    row = TABLES[kind].rows().get(name)
    if name == "stage" or (row is not None and row.named is not None):
        for each in value if isinstance(value, list) else [value]:
            allowed_code.allow_named(each)
    if row is None or not row.is_path or not isinstance(value, str) or not value:
        return value
    return str((folder / value).resolve())


def read(
    path: Path,
    overrides: Iterable[str] = (),
    copies: Mapping[str, Path] | None = None,
    stages: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, dict[str, Value]]:
    """Read the values of a parameter file by node and name, with absolute paths; a file in a bag is untrusted data.

    Args:
        path: path of the file.
        overrides: see `load`.
        copies: see `load`.
        stages: stages of nodes whose stages the file does not name.

    Raises:
        InputError: the file is invalid, or it is untrusted data and names code that is not allowed or files elsewhere.
    """
    folder = path.parent if copies is not None else allowed_code.bag_around(path.parent)
    nodes = ros_yaml.read(path)
    # Such files are collected instead of being rejected at once, since an override may name another file.
    outside: dict[tuple[str, str], Path] = {}
    for name, values in nodes.items():
        if name == _EVERYONE:
            continue
        if folder is None:
            allowed_code.allow_named(values.get("stage"))
        kind = kind_of(name, values.get("stage") or stages.get(name))
        for key, value in values.items():
            row = TABLES[kind].rows().get(key)
            if folder is None:
                values[key] = _of_user(kind, key, value, path.parent)
            elif row is not None and row.is_file and isinstance(value, str) and value:
                place = _stands_for(f"{name}.{key}", value, path.parent, copies)
                values[key] = str(place)
                is_there = place.is_relative_to(folder.resolve()) or resources.is_own(place)
                if not is_there or key in allowed_code.FILES:
                    outside[name, key] = place
    for text in overrides:
        outside.pop(_override(text, nodes), None)
    for (name, key), place in outside.items():
        what = f"a file outside of the bag {folder}" if copies is None else "a file that the bag does not hold"
        what = "machine code" if key in allowed_code.FILES else what
        raise InputError(f"{shown(f'{name}.{key} = {place}')}: {what}; allowed: --set {shown(name)}.{key}=FILE")
    return nodes


WRITTEN = ("memory_file", "restart_file")  #: parameters whose files a run may create itself


def _stands_for(parameter: str, value: str, folder: Path, copies: Mapping[str, Path] | None) -> Path:
    """Return the file for a path in untrusted data: its copy, a new file for a run to write, or the file itself."""
    if copies is not None and parameter in copies:
        return copies[parameter].resolve()
    if copies is not None and parameter.rpartition(".")[2] in WRITTEN:
        return Path(tempfile.mkdtemp(dir=folder)).resolve() / "state"
    return (folder / value).resolve()


def content(path: Path) -> str:
    """Return a hash of a file's content, or the file's name if it is missing, unreadable or above the size limit."""
    try:
        return hashlib.sha256(files.contents(path)).hexdigest()
    except OSError:
        return path.name  # the reader of the file reports why it cannot be read


def _fingerprint(table: NodeParameters) -> str:
    """Return a hash of the parameters of a table that affect a run; empty if there are none."""
    if isinstance(table, RecorderParameters):
        return ""
    values = table.model_dump(exclude=HOST_PARAMETERS | table.judging)
    for row in type(table).rows().values():
        if row.is_path and values[row.name]:
            values[row.name] = content(Path(values[row.name]))
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _identity(fingerprints: Mapping[str, str]) -> str:
    """Return a run ID derived from a scenario's content, so that two runs of the scenario produce the same messages."""
    return _hash(fingerprints)[:16]


def _hash(fingerprints: Mapping[str, str]) -> str:
    said = {node: fingerprint for node, fingerprint in fingerprints.items() if fingerprint}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _agreed(name: str, tables: Mapping[str, NodeParameters], fingerprints: Mapping[str, str], run_id: str) -> Scenario:
    """Build the scenario from parameter tables and a run ID.

    Raises:
        InputError: the nodes have different values for a shared parameter.
    """
    agreed = next(iter(tables.values()))
    for node, table in tables.items():
        for key in SharedParameters.model_fields:
            if getattr(table, key) != getattr(agreed, key):
                raise InputError(
                    f"{node}.{key} = {getattr(table, key)}: other nodes have {getattr(agreed, key)}; "
                    f"set it under {_EVERYONE}"
                )
    named = {
        node: table if table.run_id == run_id else table.model_copy(update={"run_id": run_id})
        for node, table in tables.items()
    }
    return Scenario(name, named, fingerprints)


def of_load(value: object) -> Scenario:
    """Return a scenario that a user's program passes.

    Raises:
        InputError: it is none.
    """
    if not isinstance(value, Scenario):
        raise InputError(
            f"scenario = {value!r:.60}: {type(value).__name__}; allowed: a Scenario, as lathe_rc.load returns"
        )
    return value


def load(
    path: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    *,
    complete: bool = False,
    copies: Mapping[str, Path] | None = None,
) -> Scenario:
    """Read a scenario from a file, or by its name.

    Args:
        path: ROS 2 parameter file, or the name of a scenario that comes with lathe_rc, such as ``piston``.
        overrides: ``NODE.PARAM=VALUE``, or ``PARAM=VALUE`` for shared parameters, applied in order.
        complete: whether omitted parameters take their defaults, as in files written by `Scenario.to_yaml`; otherwise,
            drive models that are not given are taken from the drives (see `lathe_rc.cell.models`).
        copies: copies of the files of a bag's scenario, by NODE.PARAM, all in the folder of ``path``; the scenario is
            then untrusted data and may not name other files. None: the scenario is the user's own, unless it is in a
            bag (`lathe_rc.allowed_code`).

    Raises:
        InputError: the input is invalid; the one-line message describes the first error.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=20", "block_size=128"])
        >>> piston
        <Scenario piston: spindle_encoder, learning_controller, electrodynamic_actuator, tool, recorder>
        >>> piston.nodes["spindle_encoder"].revolutions, piston.shared.block_size
        (20.0, 128)
        >>> lathe_rc.load("piston", ["tol.feed=1.0"])
        Traceback (most recent call last):
        lathe_rc.errors.InputError: --set 'tol.feed=1.0': no node 'tol' in the scenario; did you mean tool?
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"load({path!r:.60}); allowed: the name of a scenario, or a file")
    if isinstance(overrides, str):
        raise InputError(f"overrides = {overrides!r}; allowed: a list of texts, [{overrides!r}]")
    path = resources.scenario(Path(path)) if copies is None else Path(path)
    nodes = read(path, overrides, copies)
    shared = nodes.pop(_EVERYONE, {})
    SharedParameters.read(_EVERYONE, shared)
    if not nodes:
        raise InputError(f"{path}: no nodes beside {_EVERYONE}")
    tables: dict[str, NodeParameters] = {}
    for name, values in nodes.items():
        for key in SharedParameters.model_fields:
            if key in values and key in shared and values[key] != shared[key]:
                given = f"{name}.{key} = {values[key]}"
                raise InputError(f"{given}: {_EVERYONE} says {shared[key]}; keep one ({key}=... sets all nodes)")
        tables[name] = TABLES[kind_of(name, values.get("stage"))].read(name, {**shared, **values})
    # An empty model that a complete file omits is given as well: no model of a drive takes its place.
    tables = {name: models.given(table) for name, table in tables.items()} if complete else models.resolved(tables)
    fingerprints = {name: _fingerprint(table) for name, table in tables.items()}
    return _agreed(path.stem, tables, fingerprints, next(iter(tables.values())).run_id or _identity(fingerprints))
