# SPDX-License-Identifier: Apache-2.0
"""Checks pages, docstrings, comments and messages for the constructions that prose.yaml refuses."""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

from workplace import PACKAGES, ROOT

FOLDERS = (*PACKAGES, *(ROOT / name for name in ("docs", "msg_defs", "tests", "tools")))
RULES = ROOT / "tools" / "prose.yaml"
# These say nothing of their content.
MODULES = {"both", "happened", "leftovers", "offered", "played", "story", "strangers", "trust", "walk", "watch"}
_CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


class Rule(NamedTuple):
    """A construction that is refused.

    Attributes:
        pattern: finds it.
        pages: it is refused in pages alone, not in Python files.
        why: it is refused.
        before, after: an example of it and of better words.
    """

    pattern: re.Pattern[str]
    pages: bool
    why: str
    before: str
    after: str


def rules() -> list[Rule]:
    """Return the rules in prose.yaml."""
    return [
        Rule(
            re.compile(row["pattern"].replace(" ", r"\s+"), re.MULTILINE),
            row.get("pages", False),
            *(row[name] for name in ("why", "before", "after")),
        )
        for row in yaml.safe_load(RULES.read_text(encoding="utf-8"))
    ]


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the first line and the words of each piece of prose: a page without its code; strings and comments."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        yield 1, _CODE.sub(lambda code: "\n" * code[0].count("\n"), text)
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def found(path: Path, refused: list[Rule]) -> Iterator[str]:
    """Yield a line for each refused construction in a file, and for a refused name of a module."""
    place = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
    if path.stem in MODULES:
        yield f"{place}: {path.stem} says nothing of the module's content"
    for line, text in texts(path):
        for rule in refused:
            if rule.pages and path.suffix == ".py":
                continue
            for match in rule.pattern.finditer(text):
                number = line + text.count("\n", 0, match.start())
                words = " ".join(match[0].split())[:40]
                yield f"{place}:{number}: {words!r}: {rule.why}; not {rule.before!r}, but {rule.after!r}"


def files() -> list[Path]:
    """Return the pages and the Python files of the checkout."""
    inside = [path for folder in FOLDERS for path in folder.rglob("*") if path.suffix in {".md", ".py"}]
    return sorted([*ROOT.glob("*.md"), *inside])


def main() -> int:
    """Print what is refused and return the exit code."""
    refused = rules()
    lines = [line for path in files() for line in found(path, refused)]
    print(*lines, sep="\n", end="\n" if lines else "")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
