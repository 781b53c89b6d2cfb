# SPDX-License-Identifier: Apache-2.0
"""Figures of an HTML page, drawn where it is read: Vega-Lite, its library, and the script that draws.

The page carries all of it. It runs these two scripts alone, known by their hashes, and nothing that a bag or a sweep
says in it.
"""

import base64
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import vl_convert

Spec = dict[str, Any]
Rows = list[dict[str, Any]]

SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"
FIT = {"type": "fit-x", "contains": "padding"}


@cache
def library() -> str:
    """Vega, Vega-Lite and vega-embed, as one script."""
    return str(vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;"))


@dataclass(eq=False)
class Charts:
    """The figures of a page.

    Attributes:
        specs: specifications by figure and choice; a figure without a choice has one of the name "".
        chosen: which is shown first.
        data: data sets that they share.
    """

    specs: dict[str, dict[str, Spec]] = field(default_factory=dict)
    chosen: dict[str, str] = field(default_factory=dict)
    data: dict[str, Rows] = field(default_factory=dict)

    def add(self, name: str, specs: Mapping[str, Spec], first: str = "") -> None:
        """Add a figure, which goes into the element of this id."""
        self.specs[name], self.chosen[name] = dict(specs), first

    @property
    def scripts(self) -> list[str]:
        """Those that draw the figures; none without figures."""
        return [library(), Path(__file__).with_name("charts.js").read_text(encoding="utf-8")] if self.specs else []

    @property
    def policy(self) -> str:
        """The page's Content-Security-Policy: it loads nothing, and runs these scripts alone."""
        return (
            f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {_allowed(self.scripts)}"
        )


def _allowed(scripts: Iterable[str]) -> str:
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    return " ".join(f"'sha256-{each}'" for each in hashes) or "'none'"
