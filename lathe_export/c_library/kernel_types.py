# SPDX-License-Identifier: Apache-2.0
"""Types of the names and expressions of a kernel, for given types of its arguments.

The subset of Python is that in which steps are written; what is outside of it is refused by module and line.
"""

import ast
import builtins
import inspect
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, Protocol, TypeGuard

import numpy as np

from lathe_export.c_library import c_types
from lathe_export.c_library.c_types import (
    BOOL,
    COMPLEX,
    FLOAT,
    INT,
    NONE,
    OCTET,
    WORD,
    ArrayType,
    PortsType,
    RecordType,
    TupleType,
    Type,
)
from lathe_rc.compiled.struct_view import StructView
from lathe_rc.errors import LatheError

_REALS = ArrayType(FLOAT, 1)
_MATH = {
    np.floor: "floor", np.ceil: "ceil", np.sqrt: "sqrt", np.sin: "sin", np.cos: "cos", np.tan: "tan", np.exp: "exp",
    np.expm1: "expm1", np.log: "log", np.log1p: "log1p", np.cbrt: "cbrt", np.arctan: "atan", np.rint: "rint",
    np.trunc: "trunc", np.sign: "sign", np.tanh: "tanh", np.arcsin: "asin", np.arccos: "acos",
}  # fmt: skip
#: functions of a library: number of arguments, type, and text in C
LIBRARY: dict[Any, tuple[int, Type, str]] = {
    **{function: (1, FLOAT, f"{name}({{0}})") for function, name in _MATH.items()},
    np.arctan2: (2, FLOAT, "atan2({0}, {1})"),
    np.hypot: (2, FLOAT, "hypot({0}, {1})"),
    np.fmod: (2, FLOAT, "fmod({0}, {1})"),
    np.copysign: (2, FLOAT, "copysign({0}, {1})"),
    np.isnan: (1, BOOL, "isnan({0})"),
    np.isfinite: (1, BOOL, "isfinite({0})"),
    np.sum: (1, FLOAT, "real_sum({0})"),
    np.searchsorted: (2, INT, "search_left({0}, {1})"),
    complex: (2, COMPLEX, "(complex_number){{{0}, {1}}}"),
    np.empty: (1, _REALS, "real_empty(room, {0})"),
    np.zeros: (1, _REALS, "real_full(room, {0}, 0.0)"),
    np.full: (2, _REALS, "real_full(room, {0}, {1})"),
    np.empty_like: (1, _REALS, "real_empty(room, ({0}).size)"),
    np.concatenate: (2, _REALS, "real_joined(room, {0}, {1})"),
}
LIBM = {*_MATH.values(), "atan2", "hypot", "fmod", "copysign", "fabs", "pow"} - {"sign"}
CASTS = {float: FLOAT, np.float64: FLOAT, int: INT, np.int64: INT, np.uint64: WORD, np.uint8: OCTET, bool: BOOL}
MISSING = object()  #: what is no constant


class UnprintableError(LatheError):
    """A kernel uses something that the printer does not know."""


class Kernels(Protocol):
    """Kernels that others call."""

    def function(self, function: Callable[..., Any], given: Sequence[Type]) -> "KernelTypes":
        """Return a kernel for some types of its arguments."""
        ...


class KernelTypes:
    """Kernel for one combination of argument types.

    Args:
        kernels: the others.
        function: the kernel in Python.
        types: types of its arguments.

    Attributes:
        function: see the arguments.
        source, tree: its text, and its syntax without annotations and dead branches.
        given: names of its arguments.
        kinds: type of each local name.
        result: type of what it returns.
        takes_room: it needs memory for temporary arrays.
        writes: it, or what it calls, writes to arrays.
    """

    def __init__(self, kernels: Kernels, function: Callable[..., Any], types: Sequence[Type]) -> None:
        self._kernels, self.function = kernels, function
        try:
            self.source = textwrap.dedent(inspect.getsource(function))
        except OSError:
            raise UnprintableError(f"{function.__module__}.{function.__qualname__} has no source file") from None
        (tree,) = ast.parse(self.source).body
        assert isinstance(tree, ast.FunctionDef), "a kernel is a function"
        self._scope = {**function.__globals__, **inspect.getclosurevars(function).nonlocals}
        self.given = [each.arg for each in tree.args.args]
        if len(types) != len(self.given):
            raise self.unknown(tree, f"{len(types)} arguments")
        self.kinds: dict[str, Type] = dict(zip(self.given, types, strict=True))
        self.tree: ast.FunctionDef = _Pruned(self.kinds).visit(tree)
        self.result: Type = NONE
        self.takes_room = self.writes = False
        self._infer()

    def unknown(self, node: ast.AST, what: str) -> UnprintableError:
        """Return the error for something that the printer does not know."""
        line = self.function.__code__.co_firstlineno + getattr(node, "lineno", 1) - 1
        return UnprintableError(f"{self.function.__module__}, line {line}: {what} cannot be printed as C")

    def _infer(self) -> None:
        """Find the types of the local names, and what the function returns and needs."""
        for _ in range(8):
            before = dict(self.kinds), self.result
            for node in ast.walk(self.tree):
                self._pass(node)
            if before == (self.kinds, self.result):
                break
        else:
            raise self.unknown(self.tree, "a function whose names keep changing their types")
        called = [*self.calls()]
        self.writes = any(map(self._stores, ast.walk(self.tree))) or any(each.writes for each in called)
        self.takes_room = any(map(self.takes_memory, ast.walk(self.tree))) or any(each.takes_room for each in called)

    def _stores(self, node: ast.AST) -> bool:
        """Return whether a node writes to an array."""
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            return isinstance(self.kind(node.target), ArrayType)
        return isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store)

    def _pass(self, node: ast.AST) -> None:
        """Take the types that a statement tells."""
        if isinstance(node, ast.Assign):
            for target in node.targets:
                self._assign(target, node.value)
        elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            self._hold(node.target, self.maybe(operation(node)))
        elif isinstance(node, ast.For):
            self._loop(node)
        elif isinstance(node, ast.Return) and node.value is not None and (kind := self.maybe(node.value)) is not None:
            try:
                self.result = c_types.joined([self.result, kind] if self.result != NONE else [kind])
            except TypeError as error:
                raise self.unknown(node, f"a function that returns {error}") from None

    def maybe(self, node: ast.expr) -> Type | None:
        """Return the type of an expression; None as long as a name in it has none."""
        try:
            return self.kind(node)
        except KeyError:
            return None

    def _hold(self, target: ast.Name, kind: Type | None) -> None:
        if kind is None:
            return
        known = [self.kinds[target.id]] if target.id in self.kinds else []
        try:
            self.kinds[target.id] = c_types.joined([*known, kind])
        except TypeError as error:
            raise self.unknown(target, f"{target.id} for {error}") from None

    def _assign(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Name):
            self._hold(target, self.maybe(value))
        elif isinstance(target, ast.Tuple):
            if isinstance(value, ast.Tuple):
                for one, other in zip(target.elts, value.elts, strict=True):
                    self._assign(one, other)
                return
            kind = self.maybe(value)
            parts = kind.parts if isinstance(kind, TupleType) else (kind and INT,) * len(target.elts)
            if isinstance(kind, ArrayType):
                parts = (kind.element,) * len(target.elts)
            for one, part in zip(target.elts, parts, strict=True):
                if isinstance(one, ast.Name):
                    self._hold(one, part)

    def _loop(self, node: ast.For) -> None:
        value = node.iter
        if self.is_call(value, range):
            self._assign(node.target, ast.copy_location(ast.Constant(0), node))
            return
        if self.is_call(value, enumerate) and isinstance(node.target, ast.Tuple):
            count, each = node.target.elts
            self._hold(count, INT)  # type: ignore[arg-type]
            self._hold(each, self._element(value.args[0]))  # type: ignore[arg-type]
            return
        if isinstance(value, ast.Tuple):
            for each in value.elts:
                self._assign(node.target, each)
            return
        if isinstance(node.target, ast.Name):
            self._hold(node.target, self._element(value))
            return
        raise self.unknown(node, "this loop")

    def is_call(self, node: ast.AST, function: object) -> TypeGuard[ast.Call]:
        """Return whether an expression calls a function of Python, such as range."""
        return isinstance(node, ast.Call) and self.constant(node.func) is function

    def _element(self, node: ast.expr) -> Type | None:
        kind = self.maybe(node)
        if isinstance(kind, TupleType) and kind.alike:
            return kind.parts[0]
        if isinstance(kind, ArrayType):
            return kind.element if kind.dimensions == 1 else ArrayType(kind.element, 1)
        if kind is None:
            return None
        raise self.unknown(node, "a loop over this")

    def constant(self, node: ast.AST) -> Any:  # noqa: PLR0911 - one case after the other
        """Return the value of an expression of global names and literals; `MISSING` if it has local ones."""
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            if node.id in self.kinds or node.id in self.given:
                return MISSING
            if node.id in self._scope:
                return self._scope[node.id]
            return getattr(builtins, node.id, MISSING)
        if isinstance(node, ast.Attribute):
            owner = self.constant(node.value)
            return MISSING if owner is MISSING else getattr(owner, node.attr)
        if isinstance(node, ast.Subscript) and not isinstance(node.slice, ast.Slice):
            owner, place = self.constant(node.value), self.constant(node.slice)
            return owner[place] if isinstance(owner, tuple) and place is not MISSING else MISSING
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            value = self.constant(node.operand)
            return MISSING if value is MISSING else -value
        return MISSING

    def kind(self, node: ast.expr) -> Type:
        """Return the type of an expression.

        Raises:
            KeyError: a name in it has no type yet.
            UnprintableError: the printer does not know it.
        """
        value = self.constant(node)
        if value is not MISSING:
            kind = c_types.of_value(value)
            if kind is None:
                raise self.unknown(node, ast.unparse(node))
            return kind
        found = getattr(self, f"_kind_{type(node).__name__.lower()}", None)
        if found is None:
            raise self.unknown(node, ast.unparse(node))
        return found(node)

    def _kind_name(self, node: ast.Name) -> Type:
        return self.kinds[node.id]

    def _kind_tuple(self, node: ast.Tuple) -> Type:
        return TupleType(tuple(self.kind(each) for each in node.elts))

    def _kind_compare(self, _node: ast.Compare) -> Type:
        return BOOL

    def _kind_boolop(self, node: ast.BoolOp) -> Type:
        kinds = {self.kind(each) for each in node.values}
        return BOOL if kinds <= {BOOL} else INT

    def _kind_unaryop(self, node: ast.UnaryOp) -> Type:
        return BOOL if isinstance(node.op, ast.Not) else self.kind(node.operand)

    def _kind_ifexp(self, node: ast.IfExp) -> Type:
        return c_types.joined([self.kind(node.body), self.kind(node.orelse)])

    def _kind_binop(self, node: ast.BinOp) -> Type:
        one, other = self.kind(node.left), self.kind(node.right)
        if isinstance(one, ArrayType) or isinstance(other, ArrayType):
            if {getattr(kind, "element", FLOAT) for kind in (one, other)} != {FLOAT}:
                raise self.unknown(node, f"{ast.unparse(node)} of other numbers than float64")
            return one if isinstance(one, ArrayType) else other
        if WORD in (one, other) and one != other and not isinstance(node.op, ast.LShift | ast.RShift):
            raise self.unknown(node, f"{one} beside {other}")
        if isinstance(node.op, ast.Div):
            return c_types.joined([one, other, FLOAT])
        bits = isinstance(node.op, ast.BitAnd | ast.BitOr | ast.BitXor)
        found = c_types.joined([one, other])
        return found if bits or found not in (BOOL, OCTET) else INT

    def _kind_attribute(self, node: ast.Attribute) -> Type:
        owner = self.kind(node.value)
        if owner == COMPLEX and node.attr in ("real", "imag"):
            return FLOAT
        if isinstance(owner, StructView) and node.attr in owner.members:
            return c_types.of_numba(owner.members[node.attr][0])
        if isinstance(owner, RecordType) and node.attr in owner.kind._fields:
            return owner.parts[owner.kind._fields.index(node.attr)]
        if isinstance(owner, ArrayType) and node.attr == "size":
            return INT
        if isinstance(owner, ArrayType) and node.attr == "shape":
            return TupleType((INT,) * owner.dimensions)
        raise self.unknown(node, ast.unparse(node))

    def _kind_subscript(self, node: ast.Subscript) -> Type:
        owner, index = self.kind(node.value), node.slice
        if isinstance(owner, TupleType):
            place = self.constant(index)
            if place is MISSING and not owner.alike:
                raise self.unknown(node, ast.unparse(node))
            if isinstance(index, ast.Slice):
                return TupleType(owner.parts[slice(*self.ends(index))])
            return owner.parts[0 if place is MISSING else place]
        if isinstance(owner, PortsType):
            return ArrayType(FLOAT, 1)
        if not isinstance(owner, ArrayType):
            raise self.unknown(node, ast.unparse(node))
        places = index.elts if isinstance(index, ast.Tuple) else [index]
        left = owner.dimensions - sum(not isinstance(place, ast.Slice) for place in places)
        return ArrayType(owner.element, left) if left else owner.element

    def ends(self, part: ast.Slice) -> list[Any]:
        """Return the constant ends and step of a slice of a tuple."""
        ends = [None if each is None else self.constant(each) for each in (part.lower, part.upper, part.step)]
        if MISSING in ends:
            raise self.unknown(part, "this part of a tuple")
        return ends

    def _kind_call(self, node: ast.Call) -> Type:  # noqa: PLR0911 - one case after the other
        if (called := self.called(node)) is not None:
            return called.result
        function = self.constant(node.func)
        if is_record(function):
            return RecordType(tuple(self.kind(each) for each in self.arguments(node, function)), function)
        if function in (min, max, abs, np.abs):
            return c_types.joined([self.kind(each) for each in node.args])
        if function is len:
            return INT
        if function in CASTS:
            return CASTS[function]
        if is_copy(node):
            return _REALS
        return self.library(node)[0]

    def library(self, node: ast.Call) -> tuple[Type, str, list[ast.expr]]:
        """Return type, text in C and arguments of a call of a function of a library.

        Raises:
            UnprintableError: the printer does not know it, or not with these arguments.
        """
        function, arguments = self.constant(node.func), node.args
        given = {each.arg: each.value for each in node.keywords}
        count, kind, text = LIBRARY.get(function, (-1, NONE, ""))
        if function is np.concatenate and isinstance(arguments[0], ast.Tuple):
            arguments = arguments[0].elts
        if function is np.searchsorted and "side" in given:
            text = text.replace("left", str(self.constant(given.pop("side"))))
        if len(arguments) != count or given:
            raise self.unknown(node, ast.unparse(node))
        return kind, text, arguments

    def takes_memory(self, node: ast.AST) -> bool:
        """Return whether an expression makes a temporary array, other than in a kernel that it calls."""
        if (
            isinstance(node, ast.Call)
            and self.constant(node.func) not in (range, enumerate)
            and self.called(node) is None
        ):
            return isinstance(self.kind(node), ArrayType)
        return isinstance(node, ast.BinOp) and isinstance(self.kind(node), ArrayType)

    def called(self, node: ast.Call) -> "KernelTypes | None":
        """Return the kernel that is called; None if it is none.

        Raises:
            KeyError: an argument has no type yet.
        """
        kernel = self.constant(node.func)
        function = getattr(kernel, "py_func", None)
        if function is None:
            return None
        return self._kernels.function(function, [self.kind(each) for each in self.arguments(node, function)])

    def arguments(self, node: ast.Call, function: Callable[..., Any]) -> list[ast.expr]:
        """Return the arguments of a call in order: those by name and the parts of a tuple too."""
        found: list[ast.expr] = []
        for each in node.args:
            if isinstance(each, ast.Starred):
                kind = self.kind(each.value)
                if not isinstance(kind, TupleType):
                    raise self.unknown(node, ast.unparse(each))
                found += [
                    ast.copy_location(ast.Subscript(each.value, ast.Constant(place), ast.Load()), node)
                    for place in range(len(kind.parts))
                ]
            else:
                found.append(each)
        given = {each.arg: each.value for each in node.keywords}
        for name, parameter in list(inspect.signature(function).parameters.items())[len(found) :]:
            if name in given:
                found.append(given[name])
            else:
                found.append(ast.copy_location(ast.Constant(parameter.default), node))
        return found

    def calls(self) -> Iterator["KernelTypes"]:
        """Yield the functions that this one calls."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Call) and (called := self.called(node)) is not None:
                yield called

    def is_positive(self, node: ast.expr) -> bool:  # noqa: PLR0911 - one case after the other
        """Return whether an integer is known to be at least 0."""
        value = self.constant(node)
        if value is not MISSING:
            return bool(value >= 0)
        if isinstance(node, ast.Name):
            return node.id in self._counted
        if isinstance(node, ast.Attribute):
            return node.attr == "size"
        if isinstance(node, ast.Subscript):
            return isinstance(node.value, ast.Attribute) and node.value.attr == "shape"
        if isinstance(node, ast.Call):
            return self.constant(node.func) is len
        if isinstance(node, ast.BinOp):
            left, right = node.left, node.right
            if isinstance(node.op, ast.Sub):
                return isinstance(left, ast.Attribute) and left.attr == "size" and self.constant(right) == 1
            if isinstance(node.op, ast.Mod):
                return self.is_positive(right)
            if isinstance(node.op, ast.BitAnd):
                return self.is_positive(left) or self.is_positive(right)
            if isinstance(node.op, ast.Add | ast.Mult | ast.FloorDiv):
                return self.is_positive(left) and self.is_positive(right)
        return False

    @cached_property
    def _counted(self) -> set[str]:
        """Local names of which each assigned value is at least 0."""
        assigned: dict[str, list[ast.expr | None]] = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Assign | ast.AugAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for target in targets:
                    for one, value in self._pairs(target, node.value):
                        keeps = isinstance(node, ast.Assign) or isinstance(node.op, ast.Add)
                        assigned.setdefault(one, []).append(value if keeps else None)
            elif isinstance(node, ast.For):
                for name in names_in(node.target):
                    arguments = node.iter.args if self.is_call(node.iter, range) else []
                    starts = {1: ast.Constant(0), 2: arguments[0]} if arguments else {}
                    assigned.setdefault(name, []).append(starts.get(len(arguments)))
        self.__dict__["_counted"] = found = {
            name for name in assigned if name not in self.given and self.kinds.get(name) == INT
        }
        while True:
            left = {name for name in found if all(v is not None and self.is_positive(v) for v in assigned[name])}
            if left == found:
                return found
            self.__dict__["_counted"] = found = left

    def _pairs(self, target: ast.expr, value: ast.expr | None) -> Iterator[tuple[str, ast.expr | None]]:
        if isinstance(target, ast.Name):
            yield target.id, value
        elif isinstance(target, ast.Tuple):
            values = value.elts if isinstance(value, ast.Tuple) else [None] * len(target.elts)
            for one, other in zip(target.elts, values, strict=True):
                yield from self._pairs(one, other)


class _Pruned(ast.NodeTransformer):
    """Leaves out annotations, and the branches for arguments that are, or are not, None.

    Args:
        kinds: types of the arguments.
    """

    def __init__(self, kinds: Mapping[str, Type]) -> None:
        self._kinds = kinds

    def _known(self, test: ast.expr) -> bool | None:
        if (
            isinstance(test, ast.Compare)
            and isinstance(test.left, ast.Name)
            and isinstance(test.ops[0], ast.Is | ast.IsNot)
        ):
            return (self._kinds.get(test.left.id) == NONE) == isinstance(test.ops[0], ast.Is)
        return None

    def visit_If(self, node: ast.If) -> Any:
        self.generic_visit(node)
        known = self._known(node.test)
        return node if known is None else (node.body if known else node.orelse)

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        self.generic_visit(node)
        known = self._known(node.test)
        return node if known is None else (node.body if known else node.orelse)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.annotation = None
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        node.returns = None
        self.generic_visit(node)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.stmt:
        assert node.value is not None, "it has a value"
        return ast.copy_location(ast.Assign([node.target], node.value), node)


def operation(node: ast.AugAssign) -> ast.BinOp:
    """Return the operation of an assignment such as ``a += b``."""
    load = ast.parse(ast.unparse(node.target), mode="eval").body
    return ast.copy_location(ast.BinOp(load, node.op, node.value), node)


def is_copy(node: ast.Call) -> bool:
    """Return whether an array is copied."""
    return isinstance(node.func, ast.Attribute) and node.func.attr == "copy" and not node.args


def is_record(value: object) -> bool:
    """Return whether a value is a class of NamedTuples."""
    return isinstance(value, type) and issubclass(value, tuple) and hasattr(value, "_fields")


def names_in(target: ast.expr) -> list[str]:
    """Return the names that a target assigns to."""
    return [each.id for each in ast.walk(target) if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)]
