# SPDX-License-Identifier: Apache-2.0
"""Parameter tables, which define the type, default, range, unit and description of each parameter.

ROS descriptors, validation, help and the documentation are generated from these tables.
"""

import copy
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast, get_args, get_origin

import numpy as np
from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from lathe_rc.cell.judged import Judged
from lathe_rc.errors import InputError, shown
from lathe_rc.extensions import Named
from lathe_rc.messages import MAX_BLOCK, Samples
from lathe_rc.names import instead

NonNegative = Annotated[float, Ge(0)]  #: most quantities, including those that 0 switches off
Positive = Annotated[float, Gt(0)]  #: quantities that are used as divisors

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]
Values = Mapping[str, Value]  #: values by parameter name

T = TypeVar("T", bound="Table")

_LONGEST = 60  # maximum length of a value in a summary [characters]
_FAR = 1e9  # ratio of a value to its default, or the inverse, from which floating point may fail
_HUGE = 1e12  # magnitude from which floating point may fail, if the default is 0
_NAMES = {bool: "true or false", int: "an integer", float: "a finite number", str: "a text"}


def parameter(default: Any, doc: str, unit: str = "1", *, path: bool = False, drive: str = "") -> Any:
    """Define a field of a parameter table; ``path`` marks a file name relative to the scenario's folder.

    ``drive`` marks a parameter as a controller's model of a quantity of the commanded drive, named as in
    `NodeParameters.drive_models`; the default of such a parameter is the drive's value (`lathe_rc.cell.models`).

    Ranges are part of the annotation.

    Example:
        >>> from typing import Annotated
        >>> from annotated_types import Gt
        >>> from lathe_rc import NodeParameters, parameter
        >>> class Gains(NodeParameters):
        ...     learning_gain: Annotated[float, Gt(0)] = parameter(1.0, "part of the error that a revolution learns")
        ...     lead_time: float = parameter(0.0, "lead of the memory", "s")
    """
    doc = f"{doc}; not given in a scenario: that of the drive" if drive else doc
    return Field(default=default, description=doc, json_schema_extra={"unit": unit, "path": path, "drive": drive})


class ParameterRow:
    """Row of a parameter listing, as shown to users and in ROS.

    Attributes:
        name: parameter name.
        type: type of the value, or of its elements.
        is_list: whether the value is an array.
        choices: allowed strings; empty if unrestricted.
        is_file: whether the value is a path, relative to the scenario or not.
        named: kind of third-party classes that may be named as well; None if there is none.
        low, high: range of a number, infinite if unlimited; ``limits`` states whether the ends are included.
        limits: the range in words; empty if there is none.
        drive: quantity of the commanded drive that the parameter models (see `parameter`); empty if there is none.
    """

    def __init__(self, name: str, info: FieldInfo) -> None:
        if not isinstance(info.json_schema_extra, dict) or "unit" not in info.json_schema_extra:
            raise InputError(
                f"the table's {name} is no parameter; allowed: {name}: TYPE = parameter(DEFAULT, DOC, UNIT)"
            )
        extra = cast("dict[str, Any]", info.json_schema_extra)
        self.name, self.doc = name, info.description or ""
        self.default: Value = info.get_default(call_default_factory=True)
        self.unit, self.is_path, self.drive = str(extra["unit"]), bool(extra["path"]), str(extra["drive"])
        self.is_file = self.is_path or name.endswith("_file")
        annotation: Any = info.annotation
        metadata = list(info.metadata)
        self.is_list = get_origin(annotation) is list
        if self.is_list:
            (annotation,) = get_args(annotation)
        if get_origin(annotation) is Annotated:
            annotation, *inner = get_args(annotation)
            metadata += inner
        self.choices: tuple[str, ...] = get_args(annotation) if get_origin(annotation) is Literal else ()
        self.named: Named[Any] | None = next((limit for limit in metadata if isinstance(limit, Named)), None)
        if self.named is not None:
            self.choices = self.named.choices
        self.type: type = str if self.choices else annotation
        if self.type not in _NAMES:
            raise InputError(f"the table's {name} is a {annotation}; allowed: bool, int, float, str, or a list of one")
        self.low, self.high, words = -math.inf, math.inf, []
        for limit in metadata:
            if isinstance(limit, Ge | Gt):
                self.low = float(cast("float", limit.ge if isinstance(limit, Ge) else limit.gt))
                words.append(f"{'from' if isinstance(limit, Ge) else 'above'} {self.low:.10g}")
            elif isinstance(limit, Le | Lt):
                self.high = float(cast("float", limit.le if isinstance(limit, Le) else limit.lt))
                words.append(f"{'up to' if isinstance(limit, Le) else 'below'} {self.high:.10g}")
            elif isinstance(limit, MinLen):
                words.append("not empty")
        self.limits = " ".join(words)

    def element(self) -> "ParameterRow":
        """Return the row for a single element of a list parameter."""
        found = copy.copy(self)
        found.is_list = False
        return found

    def allowed(self) -> str:
        """Return the permitted values of the parameter in words."""
        what = f"one of {', '.join(self.choices)}" if self.choices else _NAMES[self.type]
        what = self.named.allowed() if self.named else what
        text = " ".join(filter(None, (what, self.limits)))
        if self.is_list:
            text = f"a list, each {text}"
        return text if self.unit == "1" else f"{text} [{self.unit}]"


class Table(BaseModel):
    """Immutable parameter set that rejects unknown names, wrong types and values out of range.

    Attributes:
        listing: command that lists the parameters of a kind of node or a study; empty if there is none.
    """

    listing: ClassVar[str] = ""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)

    def __setattr__(self, name: str, value: object) -> None:
        """Reject the assignment.

        Raises:
            InputError: always.
        """
        raise InputError(
            f"{name} = {value!r:.60}: parameters are fixed; allowed: scenario.varied({{'NODE.{name}': VALUE}})"
        )

    @classmethod
    def rows(cls) -> Mapping[str, ParameterRow]:
        """Return the parameter rows by name."""
        return _rows(cls)

    def other_than_default(self, names: Collection[str]) -> str:
        """Return the non-default parameters among ``names``, in words."""
        told = []
        for row in self.rows().values():
            value = getattr(self, row.name)
            if value != row.default and row.name != "stage" and row.name in names:
                text = Path(value).name if row.is_path else str(value)
                short = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"
                told.append(f"{row.name} = {short}" if row.unit == "1" else f"{row.name} = {short} {row.unit}")
        return ", ".join(told)

    @classmethod
    def read(cls: type[T], node: str, values: Mapping[str, object]) -> T:
        """Build the table from values by parameter name; missing parameters take their defaults.

        Raises:
            InputError: a value is invalid; the one-line message describes the first such value and names ``node``.
        """
        try:
            return cls(**values)
        except InputError as error:  # from a `model_post_init`, whose messages begin with a parameter, or from a class
            dot = "." if str(error).partition(" ")[0].rstrip(",:") in cls.model_fields else ": "
            raise InputError(f"{node}{dot}{error}") from None
        except ValidationError as error:
            first = error.errors()[0]
            name = str(first["loc"][0])
            if first["type"] == "extra_forbidden":
                listing = cls.listing.format(shown(values.get("stage") or node))
                known = instead(name, sorted(cls.model_fields), listing=listing)
                raise InputError(f"{shown(f'{node}.{name}')}: unknown parameter; {known}") from None
            if why := str(first.get("ctx", {}).get("error", "")):  # the name exists, but the class cannot be used
                raise InputError(f"{node}.{name}: {why}") from None
            given = f"{values.get(name, cls.model_fields[name].default)!r:.200}"
            raise InputError(f"{node}.{name} = {given}; allowed: {cls.rows()[name].allowed()}") from None

    @classmethod
    def checked(cls, node: str, name: str, value: object) -> Any:
        """Return the value of one parameter, converted to its type; raises as `read`."""
        try:
            return _check(cls, name)(value)
        except (KeyError, InputError, ValidationError):
            return getattr(cls.read(node, {name: value}), name)

    def changed(self: T, node: str, values: Mapping[str, object]) -> T:
        """Return a copy of the table with other values; raise the same errors as `read`."""
        kind = type(self)
        checks = kind.__pydantic_decorators__  # validators of third-party tables may use all values
        if not (checks.field_validators or checks.model_validators):
            try:
                # Only the changed values are checked: the cells of a batch differ in a few values.
                found = self.model_copy(update={name: _check(kind, name)(value) for name, value in values.items()})
                found.model_post_init(None)
            except (KeyError, InputError, ValidationError):
                pass  # the complete table is read again, which reports the error
            else:
                return found
        return kind.read(node, {**self.model_dump(exclude_unset=True), **values})


@cache
def _check(table: type[Table], name: str) -> Callable[[object], Any]:
    """Return the validator of a parameter, which returns the converted value or raises ValidationError."""
    field = table.model_fields[name]
    annotated: Any = Annotated
    parts: tuple[Any, ...] = (field.annotation, *field.metadata)
    kind: Any = annotated[parts] if field.metadata else field.annotation
    config = ConfigDict(strict=True, allow_inf_nan=False)
    found: TypeAdapter[Any] = TypeAdapter(kind, config=config)
    return found.validate_python


@contextmanager
def about(node: str, *names: str) -> Iterator[None]:
    """Prefix errors with the names of the parameters at fault, as ``node.a, b: ...``, unless already prefixed.

    Physics and control code is independent of parameter names; the stage that passes values from a table knows them.
    """
    try:
        yield
    except InputError as error:
        if not str(error).startswith(f"{node}."):
            error.args = (f"{node}.{', '.join(names)}: {str(error).removeprefix(f'{node}: ')}",)
        raise


def names_others(table: type[Table], values: Mapping[str, object]) -> bool:
    """Return whether one of the values names a third-party class."""
    rows = ((row.named, values.get(name, row.default)) for name, row in table.rows().items())
    return any(named and named.others(value) for named, value in rows)


@cache
def _rows(table: type[Table]) -> Mapping[str, ParameterRow]:
    return {name: ParameterRow(name, info) for name, info in table.model_fields.items()}


class SharedParameters(Table):
    """Parameters shared by all nodes of a cell, which may be set under ``/**`` in a parameter file."""

    sample_rate: Annotated[int, Ge(1000), Le(1_000_000)] = parameter(
        64_000, "sampling rate of the cell; the step must be a whole number of nanoseconds", "Hz"
    )
    block_size: Annotated[int, Ge(1), Le(MAX_BLOCK)] = parameter(64, "samples in a block", "sample")
    nominal_rpm: Annotated[float, Gt(0), Le(60_000)] = parameter(1000.0, "nominal spindle speed", "1/min")
    seed: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(0, "seed of everything random in the cell")
    allow_faults: bool = parameter(default=False, doc="let the nodes take faults; otherwise they are refused")
    joint_state_period: Annotated[int, Ge(1)] = parameter(1280, "a JointState message every so many samples", "sample")
    window: Annotated[int, Ge(0), Le(4096)] = parameter(
        64, "blocks in flight, counted from the slowest member; 0: free-running, may lose blocks", "block"
    )
    run_id: str = parameter("", "identity of the run; every block carries it")

    def model_post_init(self, context: Any, /) -> None:
        """Reject a sampling rate whose step is not a whole number of nanoseconds."""
        if 1_000_000_000 % self.sample_rate:
            low = next(r for r in range(self.sample_rate, 0, -1) if 1_000_000_000 % r == 0)
            high = next(r for r in range(self.sample_rate, 1_000_000_001) if 1_000_000_000 % r == 0)
            raise InputError(
                f"sample_rate = {self.sample_rate} Hz: its step is not a whole number of ns; "
                f"allowed nearby: {low} or {high} Hz"
            )
        if not self.run_id.isprintable() or len(self.run_id.encode()) > 64:
            raise InputError(f"run_id = {self.run_id!r}; allowed: printable text of at most 64 bytes")

    @property
    def step_ns(self) -> int:
        """Sampling step [ns]."""
        return 1_000_000_000 // self.sample_rate

    @property
    def step(self) -> float:
        """Sampling step [s]."""
        return 1.0 / self.sample_rate

    @property
    def nominal_speed(self) -> float:
        """Nominal spindle speed Ω0 [rad/s]."""
        return self.nominal_rpm * math.pi / 30.0


class NodeParameters(SharedParameters):
    """Parameters common to all nodes.

    Attributes:
        judging: parameters that affect only the assessment of a run, not its samples or messages.
        causes: values that switch a cause of error off, by name of the cause (`lathe_rc.judge.budget`).
    """

    listing: ClassVar[str] = "lathe node {} --help"
    asks: ClassVar[tuple[frozenset[str], ...]] = ()  #: parameters taken from the node that knows them, unless given
    judging: ClassVar[frozenset[str]] = frozenset()
    causes: ClassVar[Mapping[str, Values]] = MappingProxyType({})

    stage: str = parameter("", "what the node is; empty: its name says it")
    remap: list[str] = parameter([], "topic names to replace, as old:=new")
    events: list[str] = parameter(
        [], "scheduled events, as 'revolution 60: freeze', 'second 3.5: freeze' or 'sample 7000: clear'"
    )
    faults: list[str] = parameter(
        [],
        "what breaks and when, as 'revolution 20 to 25: coarse/state.measured_position stuck'; without 'to' it stays",
    )
    volatile_inputs: list[str] = parameter(
        [],
        "input topics of devices that keep no messages for those who come late (default QoS), or with window = 0 are "
        "best effort (sensor-data QoS)",
    )
    autostart: bool = parameter(default=True, doc="configure and activate by itself")

    def model_post_init(self, context: Any, /) -> None:
        """Reject a remapping rule that replaces nothing."""
        super().model_post_init(context)
        for rule in self.remap:
            if not all(rule.partition(":=")):
                raise InputError(f"remap = {rule!r}; allowed: old:=new")

    @property
    def commanded_topic(self) -> str:
        """Command topic, before remapping, of the drive that the node's model describes; empty without a model."""
        return ""

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Return the drive quantities available to controllers, by command topic before remapping and by quantity."""
        return {}

    def known(self) -> Values:
        """Return the values of the node that other nodes may use, by parameter name."""
        return {}

    def causes_off(self, node: str, nodes: Mapping[str, "NodeParameters"], height: Samples) -> dict[str, Values]:
        """Return the values of the node that switch further causes of a form error off, by cause.

        Args:
            node: name of the node.
            nodes: tables of the cell by node.
            height: height of the tool along the part in the revolutions that are judged [m], shape (n,).
        """
        return {}

    def judged(self) -> Judged | None:
        """Return the error of the node by which a run is judged; None if there is none."""
        return None

    def form_doubt(self, node: str) -> float:
        """Return how far the form of a node may be off between the points of its table [m]; 0 without a table."""
        return 0.0

    def shown(self) -> Mapping[str, Any]:
        """Return properties of the node that drawings of the cell show, by name; lengths in µm and mm."""
        return {}


class ObedientParameters(NodeParameters):
    """Parameters of a node that obeys the supervisor."""

    reaction_delay: Annotated[int, Ge(0), Le(2**24)] = parameter(
        0, "samples until a reaction of the supervisor is obeyed; at least a block; 0 disables reactions", "sample"
    )


class RestartParameters(NodeParameters):
    """Parameters of a node that another process may replace during a run."""

    restart_file: str = parameter(
        "", "the node's state is kept in this file, and another process of it goes on from there; empty: it is not"
    )


def judged(nodes: Mapping[str, NodeParameters]) -> dict[str, Judged]:
    """Return by node the errors by which a run of some nodes is judged."""
    return {name: found for name, table in nodes.items() if (found := table.judged())}


def form_doubt(nodes: Mapping[str, NodeParameters]) -> float:
    """Return how far the form of some nodes may be off between the points of its table [m]; 0 without a form."""
    return max((table.form_doubt(name) for name, table in nodes.items()), default=0.0)


def remapped(table: NodeParameters, topic: str) -> str:
    """Return the relative name of a topic after the node's ``remap`` rules."""
    return remapped_by(table.remap, topic)


def remapped_by(rules: Iterable[str], topic: str) -> str:
    """Return the relative name of a topic after some ``remap`` rules."""
    for rule in rules:
        old, _, new = rule.partition(":=")
        if old == topic:
            return new
    return topic


@contextmanager
def explain_overflow(tables: Mapping[str, NodeParameters]) -> Iterator[None]:
    """Convert a floating-point failure into an error that names the parameters far from their defaults.

    Args:
        tables: parameter tables of the nodes that are built or checked, by name.

    Raises:
        InputError: numbers became too large or too small, and a parameter is the cause.
    """
    try:
        yield
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        far = [each for name, table in tables.items() for each in _far(name, table)]
        if not far:
            raise
        told = f"{'; '.join(far)}: nothing can be computed with that ({error.args[-1]}); take what a machine has"
        raise InputError(told) from None


def _far(name: str, table: NodeParameters) -> Iterator[str]:
    for row in type(table).rows().values():
        value = getattr(table, row.name)
        if row.type is not float or row.is_list or not value or not isinstance(row.default, float):
            continue
        size, usual = abs(value), abs(row.default)
        if not (usual / _FAR < size < usual * _FAR if usual else size < _HUGE):
            unit = f" [{row.unit}]" if row.unit else ""
            yield f"{name}.{row.name} = {value:g}{unit} (default {row.default:g})"
