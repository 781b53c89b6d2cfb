# SPDX-License-Identifier: Apache-2.0
"""Expressions of a kernel as text in C."""

import ast
import math
import re
from typing import Any, Protocol

import numpy as np

from lathe_export.c_library import c_types
from lathe_export.c_library.c_types import BOOL, COMPLEX, FLOAT, INT, NONE, ArrayType, PortsType, TupleType, Type
from lathe_export.c_library.kernel_types import CASTS, MISSING, KernelTypes, is_copy, is_record
from lathe_rc.compiled.struct_view import StructView

_KEYWORDS = {
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while", "bool", "true", "false",
    "room", "at",
}  # fmt: skip
# Operator, and precedence in C: a higher one binds closer.
OPERATORS: dict[type[ast.AST], tuple[str, int]] = {
    ast.Mult: ("*", 13), ast.Div: ("/", 13), ast.Add: ("+", 12), ast.Sub: ("-", 12), ast.LShift: ("<<", 11),
    ast.RShift: (">>", 11), ast.Lt: ("<", 10), ast.LtE: ("<=", 10), ast.Gt: (">", 10), ast.GtE: (">=", 10),
    ast.Eq: ("==", 9), ast.NotEq: ("!=", 9), ast.BitAnd: ("&", 8), ast.BitXor: ("^", 7), ast.BitOr: ("|", 6),
    ast.And: ("&&", 5), ast.Or: ("||", 4), ast.Is: ("==", 9), ast.IsNot: ("!=", 9),
}  # fmt: skip
_COMPLEX = {"+": "sum", "-": "difference", "*": "product", "/": "quotient"}
_POWERS = {("real", 2), ("real", 3), ("real", 4), ("int", 2)}  # functions of kernels.h
PREFIX, LEAST = 14, 0  # precedences
_ATOM, _CHOICE = 16, 3


class Names(Protocol):
    """Names that a whole file shares."""

    def name(self, types: KernelTypes) -> str:
        """Return the name of a kernel."""
        ...

    def declared(self, kind: Type) -> str:
        """Return how a type is spelled."""
        ...

    def named(self, name: str, text: str) -> str:
        """Return the name of a constant."""
        ...


class Expressions:
    """Expressions of one kernel.

    Args:
        types: the kernel.
        names: names of the file.
    """

    def __init__(self, types: KernelTypes, names: Names) -> None:
        self._types, self._names = types, names

    def text(self, node: ast.expr, least: int = LEAST) -> str:
        """Return an expression in C, in parentheses if it binds less than ``least``."""
        text, binds = self._printed(node)
        return f"({text})" if binds < least else text

    def _printed(self, node: ast.expr) -> tuple[str, int]:
        value = self._types.constant(node)
        if value is not MISSING:
            return self._constant(node, value)
        found = getattr(self, f"_print_{type(node).__name__.lower()}", None)
        if found is None:
            raise self._types.unknown(node, ast.unparse(node))
        printed: tuple[str, int] = found(node)
        return printed

    def _constant(self, node: ast.expr, value: Any) -> tuple[str, int]:
        if not isinstance(c_types.of_value(value), str):
            raise self._types.unknown(node, ast.unparse(node))
        text = number(value)
        if isinstance(node, ast.Constant | ast.UnaryOp):
            return text, PREFIX if text.startswith("-") else _ATOM
        name = re.sub(r"\W+", "_", ast.unparse(node).removesuffix(".value")).strip("_")
        return self._names.named(name, text), _ATOM

    def _print_name(self, node: ast.Name) -> tuple[str, int]:
        return safe(node.id), _ATOM

    def _print_binop(self, node: ast.BinOp) -> tuple[str, int]:
        one, other = self._types.kind(node.left), self._types.kind(node.right)
        if isinstance(one, ArrayType) or isinstance(other, ArrayType):
            raise self._types.unknown(node, f"{ast.unparse(node)}, an array without a name,")
        floats = FLOAT in (one, other)
        if isinstance(node.op, ast.Pow):
            return self._power(node), _ATOM
        if isinstance(node.op, ast.Mod | ast.FloorDiv):
            name = "remainder" if isinstance(node.op, ast.Mod) else "quotient"
            return f"{'real' if floats else 'int'}_{name}({self.text(node.left)}, {self.text(node.right)})", _ATOM
        if type(node.op) not in OPERATORS:
            raise self._types.unknown(node, ast.unparse(node))
        sign, binds = OPERATORS[type(node.op)]
        if COMPLEX in (one, other):
            return f"complex_{_COMPLEX[sign]}({self._complex(node.left)}, {self._complex(node.right)})", _ATOM
        left, right = self.text(node.left, binds), self.text(node.right, binds + 1)
        if isinstance(node.op, ast.Div) and not floats:
            left = f"(double){self.text(node.left, PREFIX)}"
        if isinstance(node.op, ast.BitAnd | ast.BitOr | ast.BitXor | ast.LShift | ast.RShift):
            left, right = self.text(node.left, PREFIX), self.text(node.right, PREFIX)
        return f"{left} {sign} {right}", binds

    def _complex(self, node: ast.expr) -> str:
        text = self.text(node)
        return text if self._types.kind(node) == COMPLEX else f"(complex_number){{{text}, 0.0}}"

    def _power(self, node: ast.BinOp) -> str:
        exponent = self._types.constant(node.right)
        base = self.text(node.left)
        if isinstance(exponent, int):
            kind = "real" if self._types.kind(node.left) == FLOAT else "int"
            if (kind, exponent) not in _POWERS:
                raise self._types.unknown(node, ast.unparse(node))
            return f"{kind}_power_{exponent}({base})"
        if self._types.kind(node) != FLOAT:
            raise self._types.unknown(node, ast.unparse(node))
        return f"pow({base}, {self.text(node.right)})"

    def _print_unaryop(self, node: ast.UnaryOp) -> tuple[str, int]:
        sign = {ast.USub: "-", ast.UAdd: "+", ast.Not: "!", ast.Invert: "~"}[type(node.op)]
        return f"{sign}{self.text(node.operand, PREFIX)}", PREFIX

    def _print_compare(self, node: ast.Compare) -> tuple[str, int]:
        parts, left = [], node.left
        repeated = [*node.comparators[:-1], *([node.left] if isinstance(node.ops[0], ast.In | ast.NotIn) else [])]
        calls = (each for part in repeated for each in ast.walk(part) if isinstance(each, ast.Call))
        if any(called.writes for called in map(self._types.called, calls) if called is not None):
            raise self._types.unknown(node, f"{ast.unparse(node)}, which C would call twice,")
        for operator, right in zip(node.ops, node.comparators, strict=True):
            if isinstance(operator, ast.In | ast.NotIn):
                known = self._types.constant(right)
                of = right.elts if isinstance(right, ast.Tuple) else [ast.Constant(each) for each in known]
                among = " || ".join(f"{self.text(left, 10)} == {self.text(each, 10)}" for each in of)
                parts.append(f"{'!' if isinstance(operator, ast.NotIn) else ''}({among})")
            elif type(operator) in OPERATORS:
                sign, _ = OPERATORS[type(operator)]
                parts.append(f"{self.text(left, 11)} {sign} {self.text(right, 11)}")
            else:
                raise self._types.unknown(node, ast.unparse(node))
            left = right
        return " && ".join(parts), (9 if len(parts) == 1 else 5)

    def _print_boolop(self, node: ast.BoolOp) -> tuple[str, int]:
        sign, binds = OPERATORS[type(node.op)]
        if self._types.kind(node) != BOOL and not all(self._types.kind(each) in (BOOL, INT) for each in node.values):
            raise self._types.unknown(node, ast.unparse(node))
        return f" {sign} ".join(self.text(each, 9) for each in node.values), binds

    def refuse_choice(self, node: ast.expr) -> None:
        """Refuse ``a and b`` of numbers as a value: it is one of them in Python, and 0 or 1 in C."""
        if isinstance(node, ast.BoolOp) and self._types.kind(node) != BOOL:
            raise self._types.unknown(node, f"{ast.unparse(node)} as a value")

    def _print_ifexp(self, node: ast.IfExp) -> tuple[str, int]:
        return f"{self.text(node.test, 4)} ? {self.text(node.body, 4)} : {self.text(node.orelse, 3)}", _CHOICE

    def _print_tuple(self, node: ast.Tuple) -> tuple[str, int]:
        kind = self._names.declared(self._types.kind(node))
        inner = ", ".join(self.text(each) for each in node.elts)
        return f"({kind}){{{'{' + inner + '}' if self._types.kind(node).alike else inner}}}", _ATOM

    def _print_attribute(self, node: ast.Attribute) -> tuple[str, int]:
        owner, text = self._types.kind(node.value), self.text(node.value, 15)
        if isinstance(owner, ArrayType):
            if owner.dimensions > 1 and node.attr == "size":
                return " * ".join(f"{text}.{length}" for length in owner.lengths), 13
            return f"{text}.{node.attr}", _ATOM
        sign = "->" if isinstance(node.value, ast.Name) and isinstance(owner, StructView) else "."
        return f"{text}{sign}{safe(node.attr)}", _ATOM

    def _print_subscript(self, node: ast.Subscript) -> tuple[str, int]:
        owner, index = self._types.kind(node.value), node.slice
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            lengths = self._types.kind(node.value.value).lengths
            return f"{self.text(node.value.value, 15)}.{lengths[self._types.constant(index)]}", _ATOM
        if isinstance(owner, TupleType):
            return self._part_of_tuple(node, owner), _ATOM
        if isinstance(owner, PortsType):
            return f"port({self.text(node.value)}, {self.text(index)})", _ATOM
        return self._part_of_array(node, owner, index.elts if isinstance(index, ast.Tuple) else [index])

    def _part_of_array(self, node: ast.Subscript, owner: ArrayType, places: list[ast.expr]) -> tuple[str, int]:
        """Return an element or a part of an array, dimension by dimension."""
        text, short, left = self.text(node.value, 15), c_types.SHORT[owner.element], owner.dimensions
        if left == 3 and not isinstance(places[0], ast.Slice):
            text, places, left = f"{short}_plane({text}, {self._index(places[0], f'{text}.planes')})", places[1:], 2
        if left == 2 and len(places) == 2 and not any(isinstance(place, ast.Slice) for place in places):
            row, column = self._index(places[0], f"{text}.rows", 13), self._index(places[1], f"{text}.columns", 12)
            begin = {"0": "", "1": f"{text}.columns"}.get(row, f"{row} * {text}.columns")
            return f"{text}.data[{' + '.join(part for part in (begin, column) if part not in ('', '0')) or 0}]", _ATOM
        if left == 2 and places and not isinstance(places[0], ast.Slice):
            text, places, left = f"{short}_row({text}, {self._index(places[0], f'{text}.rows')})", places[1:], 1
        if not places:
            return text, _ATOM
        (place,) = places if len(places) == 1 else [None]
        if isinstance(place, ast.Slice) and place.step is None:
            if left == 2 and place.lower is None and place.upper is not None:
                return f"{short}_rows({text}, {self.text(place.upper)})", _ATOM
            if left == 1:
                begin = self.text(place.lower) if place.lower else "0"
                end = self.text(place.upper) if place.upper else f"{text}.size"
                return f"{short}_part({text}, {begin}, {end})", _ATOM
        elif left == 1 and place is not None and not isinstance(place, ast.Slice):
            return f"{text}.data[{self._index(place, f'{text}.size')}]", _ATOM
        raise self._types.unknown(node, ast.unparse(node))

    def _part_of_tuple(self, node: ast.Subscript, owner: TupleType) -> str:
        text, index = self.text(node.value, 15), node.slice
        if isinstance(index, ast.Slice):
            places = range(len(owner.parts))[slice(*self._types.ends(index))]
            parts = ", ".join(f"{text}.{owner.part(place)}" for place in places)
            kind = self._types.kind(node)
            return f"({self._names.declared(kind)}){{{'{' + parts + '}' if kind.alike else parts}}}"
        place = self._types.constant(index)
        if place is MISSING:
            return f"{text}.part[{self.text(index)}]"
        return f"{text}.{owner.part(place % len(owner.parts))}"

    def _index(self, node: ast.expr, size: str, least: int = LEAST) -> str:
        """Return an index, as `text`; one that may be below 0 counts from the end."""
        value = self._types.constant(node)
        if isinstance(value, int) and value < 0:
            return f"({size} - {-value})" if least > LEAST else f"{size} - {-value}"
        return self.text(node, least) if self._types.is_positive(node) else f"at({self.text(node)}, {size})"

    def _print_call(self, node: ast.Call) -> tuple[str, int]:
        if (called := self._types.called(node)) is not None:
            arguments = self._types.arguments(node, self._types.constant(node.func).py_func)
            texts = [self._argument(each) for each in arguments if self._types.kind(each) != NONE]
            return f"{self._names.name(called)}({', '.join(['room'] * called.takes_room + texts)})", _ATOM
        return self._known_call(node, self._types.constant(node.func), node.args)

    def _known_call(  # noqa: PLR0911 - one case after the other
        self, node: ast.Call, function: Any, arguments: list[ast.expr]
    ) -> tuple[str, int]:
        if function in (min, max):
            kind = "real" if self._types.kind(node) == FLOAT else "int"
            text = self.text(arguments[0])
            for each in arguments[1:]:
                text = f"{kind}_{function.__name__}({text}, {self.text(each)})"
            return text, _ATOM
        if function in (abs, np.abs):
            return f"{'fabs' if self._types.kind(node) == FLOAT else 'int_abs'}({self.text(arguments[0])})", _ATOM
        if function is len:
            kind = self._types.kind(arguments[0])
            if isinstance(kind, TupleType):
                return str(len(kind.parts)), _ATOM
            return f"{self.text(arguments[0], 15)}.{kind.lengths[0] if isinstance(kind, ArrayType) else 'count'}", _ATOM
        if function in CASTS:
            return self._cast(arguments[0], CASTS[function])
        if is_record(function):
            texts = [self.text(each) for each in self._types.arguments(node, function)]
            return f"({self._names.declared(self._types.kind(node))}){{{', '.join(texts)}}}", _ATOM
        if is_copy(node):
            assert isinstance(node.func, ast.Attribute), "a method"
            return f"real_copy(room, {self.text(node.func.value)})", _ATOM
        _, text, arguments = self._types.library(node)
        return text.format(*map(self.text, arguments)), _ATOM

    def _cast(self, node: ast.expr, kind: Type) -> tuple[str, int]:
        if self._types.kind(node) == kind:
            return self._printed(node)
        if kind == BOOL:
            return f"{self.text(node, 10)} != 0", 9
        return f"({kind}){self.text(node, PREFIX)}", PREFIX

    def _argument(self, node: ast.expr) -> str:
        """Return an argument of a kernel; a struct within another is given by its address."""
        self.refuse_choice(node)
        text = self.text(node)
        return f"&{text}" if isinstance(self._types.kind(node), StructView) and not isinstance(node, ast.Name) else text


def number(value: Any) -> str:
    """Return a number as a literal of C."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, np.uint64):
        return f"UINT64_C({int(value)})"
    if isinstance(value, float):
        if math.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        if math.isnan(value):
            return "NAN"
        return repr(float(value))
    return str(int(value)) if abs(int(value)) < 2**31 else f"INT64_C({int(value)})"


def safe(name: str) -> str:
    """Return a name that C leaves free."""
    return f"{name}_" if name in _KEYWORDS else name
