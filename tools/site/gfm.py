# SPDX-License-Identifier: Apache-2.0
"""From the Markdown of the pages, which is GitHub's, to that of Python-Markdown, which MkDocs reads.

GitHub indents what belongs to an item of a list as far as the item's text, Python-Markdown by four columns for each
level; and there a list or a table begins after a blank line only.
"""

import re

_FENCE = re.compile(r"^\s*(`{3,}|~{3,})")
_ITEM = re.compile(r"(?:[-*+]|\d+[.)]) +(?=\S)")
_COLUMNS = 4


def for_python_markdown(text: str) -> str:
    """Return a page with its lists indented for Python-Markdown."""
    lines: list[str] = []
    open_items: list[int] = []  # where the text of each open item begins
    fence = ""
    for line in text.splitlines():
        bare = line.lstrip()
        indent = len(line) - len(bare)
        if not fence and bare:
            while open_items and indent < open_items[-1]:
                open_items.pop()
        inner = open_items[-1] if open_items else 0
        shifted = " " * (_COLUMNS * len(open_items) + max(indent - inner, 0)) + bare if bare else ""
        opened = _FENCE.match(line)
        if fence:
            fence = "" if bare.rstrip() == fence else fence
        elif opened:
            fence = opened[1]
        elif (item := _ITEM.match(bare)) and indent - inner < _COLUMNS:
            if lines and lines[-1].strip() and not _is_item(lines[-1]) and not open_items:
                lines.append("")
            open_items.append(indent + item.end())
        lines.append(shifted)
    return "\n".join(lines) + "\n"


def _is_item(line: str) -> bool:
    return _ITEM.match(line.lstrip()) is not None
