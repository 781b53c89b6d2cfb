# SPDX-License-Identifier: Apache-2.0
"""Parser for ROS 2 parameter files that does not need ROS and follows rcl's rules for scalars.

YAML leaves the meaning of a scalar to the reader, and rcl's interpretation differs from that of every Python library:
``1e-3`` is a double, ``0x10`` and ``010`` are integers, and ``yes`` is true. The text is therefore parsed by PyYAML,
and the scalars by the C library's strtoll and strtod, as in rcl_yaml_param_parser. Patterns for PyYAML's resolvers
would take more lines: rcl also reads hexadecimal fractions, ``infinity`` and ``nan(5)``, and treats a number out of
range as a string.
"""

import ctypes
import errno
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

from lathe_rc import files
from lathe_rc.cell.parameters import Value
from lathe_rc.errors import InputError

_MAX_BYTES = 1 << 20
_TOO_LARGE = f"larger than {_MAX_BYTES >> 20} MiB; not a parameter file"
_MAX_DEPTH = 32
_TRUE = {"Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"}
_FALSE = {"N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"}
_SPECIAL = re.compile(r"\.(?:nan|NaN|NAN)|[+-]?\.(?:inf|Inf|INF)")
_PLAIN, _TEXT = "plain", "tag:yaml.org,2002:str"

_libc = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None, use_errno=True)
_libc.strtoll.restype, _libc.strtod.restype = ctypes.c_longlong, ctypes.c_double


def _converted(function: Callable[..., Any], text: str, *base: int) -> Any:
    """Return the number that strtoll or strtod reads from a string; None after a partial conversion or range error."""
    data, end = ctypes.create_string_buffer(text.encode()), ctypes.c_char_p()
    ctypes.set_errno(0)
    number = function(data, ctypes.byref(end), *base)
    return number if text and not end.value and not ctypes.get_errno() else None


def scalar(text: str) -> bool | int | float | str:
    """Return the value that rcl assigns to an unquoted scalar."""
    if text in _TRUE | _FALSE:
        return text in _TRUE
    number: int | float | None = _converted(_libc.strtoll, text, 0)
    if number is None:
        number = float(text.replace(".", "")) if _SPECIAL.fullmatch(text) else _converted(_libc.strtod, text)
    return text if number is None else number


class _Loader(yaml.SafeLoader):
    """YAML loader that leaves scalars unresolved, to distinguish an explicit ``!!str`` from YAML's implicit types."""

    def resolve(self, kind: object, value: object, implicit: object) -> str:
        """Return the tag of a node without an explicit tag."""
        return _PLAIN


def _name(node: yaml.Node, where: str) -> str:
    if not isinstance(node, yaml.ScalarNode) or not node.value.isprintable():
        raise InputError(f"{where}:{node.start_mark.line + 1}: a key that is no name")
    return str(node.value)


def _value(node: yaml.Node, where: str) -> Value:
    if isinstance(node, yaml.ScalarNode):
        # rcl would truncate the text, or not read it at all
        if "\0" in node.value or any("\ud800" <= character <= "\udfff" for character in node.value):
            raise InputError(f"{where}: {node.value!r}; allowed: text without NUL and surrogates")
        # Block scalars (| and >) count as plain.
        quoted = node.style in ("'", '"')
        if not node.value and not quoted:
            raise InputError(f"{where}: no value; write '' for an empty text")
        return str(node.value) if quoted or node.tag == _TEXT else scalar(node.value)
    if isinstance(node, yaml.SequenceNode):
        items = [_value(item, where) for item in node.value]
        kinds = {type(item) for item in items}
        if len(kinds) > 1 or list in kinds:
            raise InputError(f"{where}: a list of mixed types; allowed: all bool, integer, double or string")
        return items  # type: ignore[return-value]  # the check above makes it one of the list types
    raise InputError(f"{where}: neither a value nor a list")


def _flatten(node: yaml.Node, where: str, prefix: str, into: dict[str, Value]) -> None:
    """Collect parameters; nested maps form dotted names."""
    if not isinstance(node, yaml.MappingNode):
        raise InputError(f"{where}: not a map of parameters")
    for key, item in node.value:
        name = f"{prefix}{_name(key, where)}"
        if isinstance(item, yaml.MappingNode) and item.value:
            _flatten(item, where, f"{name}.", into)
        elif name in into:
            raise InputError(f"{where}: {name} appears twice; keep one")
        else:
            into[name] = _value(item, f"{where}.{name}")


def _check_events(text: str, source: str) -> None:
    """Reject YAML that rcl does not read, or that would take PyYAML forever, before building any object."""
    in_brackets: list[bool] = []
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{source}: YAML aliases; ROS 2 does not read them: write the value out")
        if isinstance(event, yaml.CollectionStartEvent):
            in_brackets.append(bool(event.flow_style))
            if len(in_brackets) > _MAX_DEPTH:
                raise InputError(f"{source}: nested more than {_MAX_DEPTH} deep; not a parameter file")
        elif isinstance(event, yaml.CollectionEndEvent):
            in_brackets.pop()
        elif isinstance(event, yaml.ScalarEvent) and not event.style and ":" in event.value and any(in_brackets):
            raise InputError(f"{source}: {event.value!r} in brackets; ROS 2 reads it in quotes only")


def _compose(text: str, source: str) -> yaml.Node | None:
    try:
        _check_events(text, source)
        return yaml.compose(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise InputError(f"{source}{place}: not YAML ({problem})") from None
    except (ValueError, OverflowError):
        raise InputError(f"{source}: not YAML (a character beyond Unicode)") from None


def parse_value(text: str, source: str) -> Value:
    """Parse a value as written in a parameter file, e.g. ``1e-3`` or ``[1, 2]``."""
    node = _compose(text, source)
    return "" if node is None else _value(node, source)


def rows(text: str, source: str) -> list[dict[str, Value]]:
    """Parse a list of maps of values, with the same scalar rules.

    Raises:
        InputError: the string is not a list of maps.
    """
    root = _compose(text, source)
    items = root.value if isinstance(root, yaml.SequenceNode) else []
    if not items or not all(isinstance(item, yaml.MappingNode) for item in items):
        raise InputError(f"{source}: no list of maps; allowed: '- {{NODE.PARAM: VALUE, ...}}', a line a cell")
    found: list[dict[str, Value]] = [{} for _ in items]
    for number, item in enumerate(items):
        _flatten(item, f"{source}: row {number + 1}", "", found[number])
    return found


def read(path: Path) -> dict[str, dict[str, Value]]:
    """Read parameters by node and name, in the order of the file.

    A leading ``/`` or ``/**/`` of a node name is removed; the wildcard for all nodes is ``/**``.

    Raises:
        InputError: the file is missing, larger than 1 MiB, or not a ROS 2 parameter file.
    """
    return parse(_text(path), str(path))


def _text(path: Path) -> str:
    try:
        return files.contents(path, _MAX_BYTES).decode()
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise InputError(f"{path}: {_TOO_LARGE}") from None
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; allowed: YAML in UTF-8") from None


def entries(path: Path) -> dict[str, dict[str, Value]]:
    """Read parameters by the full name of each entry as it is written, such as ``/left/tool`` or ``/**/tool``.

    Raises:
        InputError: see `read`.
    """
    found: dict[str, dict[str, Value]] = {}
    for key, values, where in _entries(_text(path), str(path)):
        _flatten(values, where, "", found.setdefault(key, {}))
    return found


def is_for(entry: str, node: str) -> bool:
    """Return whether rcl applies an entry of a parameter file to a node, by its fully qualified name."""
    wildcards = {"*": r"/\w+", "**": r"(/\w+)*"}
    parts = entry.removeprefix("/").split("/")
    return re.fullmatch("".join(wildcards.get(part, "/" + re.escape(part)) for part in parts), node) is not None


def parse(text: str, source: str) -> dict[str, dict[str, Value]]:
    """Parse parameters from a string, as `read` does from a file; ``source`` is the string's origin, for messages.

    Raises:
        InputError: the string is larger than 1 MiB, or not a ROS 2 parameter file.
    """
    nodes: dict[str, dict[str, Value]] = {}
    for full_name, values, where in _entries(text, source):
        _flatten(values, where, "", nodes.setdefault(_relative(full_name), {}))
    return nodes


def _relative(full_name: str) -> str:
    return "/**" if full_name == "/**" else full_name.removeprefix("/**/").removeprefix("/")


def _entries(text: str, source: str) -> Iterator[tuple[str, yaml.Node, str]]:
    """Yield the full name of each entry, the node of its parameters, and the place for messages."""
    if len(text) > _MAX_BYTES:
        raise InputError(f"{source}: {_TOO_LARGE}")
    root = _compose(text, source)
    if not isinstance(root, yaml.MappingNode):
        raise InputError(f"{source}: no nodes; allowed: 'NODE: {{ros__parameters: ...}}'")
    for key, item in root.value:
        full_name = _name(key, source)
        held = item.value if isinstance(item, yaml.MappingNode) else []
        if [each[0].value for each in held] != ["ros__parameters"]:
            raise InputError(f"{source}:{key.start_mark.line + 1}: {full_name} does not hold ros__parameters alone")
        yield full_name, held[0][1], f"{source}: {_relative(full_name)}"
