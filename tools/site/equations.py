# SPDX-License-Identifier: Apache-2.0
"""The equations of the pages, ``$...$`` in a line and blocks of ``math``, as GitHub has them: KaTeX makes HTML of them.

That happens when the site is built, so a page needs a style sheet and fonts, but no script.
"""

import json
import re
import subprocess
from pathlib import Path

from workplace import NODE, PYTHON

KATEX = NODE / "node_modules" / "katex"
_RENDERER = Path(__file__).with_name("equations.js")
_FENCED = re.compile(r"^( *)```math\n(.*?)^ *```$|^ *(`{3,}).*?^ *\3$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)|(?<![\w\\$])\$(?=\S)([^$`]+?)(?<=\S)\$(?![\w$])", re.DOTALL)
_PLACE = "\ue000{}\ue001"
_PLACES = re.compile("\ue000(\\d+)\ue001")


class EquationError(Exception):
    """KaTeX does not understand an equation."""


class Equations:
    """Takes the equations out of pages and puts what KaTeX made of them in, by one Node.js for all."""

    def __init__(self) -> None:
        node = PYTHON.with_name("node")
        self._process = subprocess.Popen(
            [node, _RENDERER, KATEX / "dist" / "katex.js"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            encoding="utf-8",
        )
        self._known: dict[tuple[str, bool], int] = {}
        self._made: list[str] = []

    def close(self) -> None:
        """End Node.js."""
        self._process.communicate()

    def take_out(self, text: str) -> str:
        """Return a page with places in the place of its equations.

        Raises:
            EquationError: KaTeX does not understand one.
        """
        parts, end = [], 0
        for found in _FENCED.finditer(text):
            parts.append(_INLINE.sub(self._inline, text[end : found.start()]))
            block = found[2]
            parts.append(found[0] if block is None else found[1] + self._place(block, display=True))
            end = found.end()
        return "".join([*parts, _INLINE.sub(self._inline, text[end:])])

    def put_in(self, html: str) -> str:
        """Return the HTML of a page with the equations in their places."""
        return _PLACES.sub(lambda found: self._made[int(found[1])], html)

    def _inline(self, found: re.Match[str]) -> str:
        return found[0] if found[1] else self._place(found[2], display=False)

    def _place(self, tex: str, *, display: bool) -> str:
        key = (tex, display)
        if key not in self._known:
            self._known[key] = len(self._made)
            self._made.append(self._render(tex, display=display))
        return _PLACE.format(self._known[key])

    def _render(self, tex: str, *, display: bool) -> str:
        assert self._process.stdin is not None, "it is a pipe"
        assert self._process.stdout is not None, "it is a pipe"
        self._process.stdin.write(json.dumps({"tex": tex, "display": display}) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        if "error" in answer:
            raise EquationError(f"{answer['error']}: {tex.strip()}")
        return f'<span class="equation" data-search-exclude>{answer["html"]}</span>'
