# SPDX-License-Identifier: Apache-2.0
"""HTML pages with figures: Vega-Lite specifications, rendered by the page itself or, as images, by this module.

The page contains Vega's library and the drawing script. Only these two scripts, identified by their hashes, can run; a
string from a bag or a sweep cannot.
"""

import base64
import hashlib
import json
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import vl_convert
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from lathe_rc.drawing.pages import own_file
from lathe_rc.messages import Samples

Spec = dict[str, Any]
Rows = list[dict[str, Any]]
Column = Samples | Sequence[float | str | None] | float | str | bool | None

_HERE = Path(__file__).parent
_PAPER = 900  # [px] width of an image, approximately that of the page
_MOST_SVG = 10**5  # [B] of a picture
_GUIDE: Spec = {"labelColor": "--soft", "titleColor": "--ink", "gridColor": "--line", "domainColor": "--soft"}
_GUIDE |= {"tickColor": "--soft", "labelFontSize": 11, "titleFontSize": 11}
#: Style of all figures; names that begin with -- are colours of the page, see page.css.
LOOK: Spec = {
    "background": None,
    "font": "system-ui, sans-serif",
    "view": {"stroke": None},
    "axis": _GUIDE,
    "legend": _GUIDE,
    "text": {"color": "--ink"},
    "title": {"color": "--ink", "fontSize": 12},
    "rule": {"color": "--soft"},
    "range": {"category": "--marks", "diverging": {"scheme": "--below-zero-above"}},
    "style": {
        "guide-label": {"fill": "--soft", "fontSize": 11},
        "guide-title": {"fill": "--ink", "fontSize": 11},
        "edge": {"stroke": "--soft"},
        "halo": {"stroke": "--paper", "strokeWidth": 4, "fontSize": 11},
    },
}


@cache
def library() -> str:
    """Return Vega, Vega-Lite and vega-embed as one script."""
    return str(vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;"))


@cache
def _light() -> Spec:
    """Return the Vega configuration `LOOK` with the colours of a light page."""
    light = own_file("page.css").partition("@media")[0]
    colours = {name: value.split() for name, value in re.findall(r"(--[\w-]+): ([^;]+);", light)}
    text = re.sub(
        r'"(--[\w-]+)"', lambda found: json.dumps(c if len(c := colours[found[1]]) > 1 else c[0]), json.dumps(LOOK)
    )
    return {**json.loads(text), "font": "sans-serif", "background": "white"}


def page_template(path: Path, **filters: Callable[[str], str]) -> Template:
    """Return the template in a file; the template can include files beside it and the parts that all pages share.

    Strings from a bag or a sweep are escaped, so that they cannot close an element.
    """
    environment = Environment(
        loader=FileSystemLoader([path.parent, _HERE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters)
    return environment.get_template(path.name)


@dataclass(eq=False)
class Charts:
    """Figures of a page.

    Attributes:
        specs: specifications by figure and choice; a figure without choices has a single one named "".
        chosen: choice shown first, by figure.
        data: data sets shared by the figures.
    """

    specs: dict[str, dict[str, Spec]] = field(default_factory=dict)
    chosen: dict[str, str] = field(default_factory=dict)
    data: dict[str, Rows] = field(default_factory=dict)

    def add(self, name: str, specs: Mapping[str, Spec], first: str = "") -> None:
        """Add a figure for the page element with the id ``name``."""
        self.specs[name], self.chosen[name] = dict(specs), first

    def place(self, specs: Sequence[Spec]) -> list[str]:
        """Add the parts of a figure without choices; return the ids of their elements."""
        count = len({name.split("-")[1] for name in self.specs})
        places = [f"figure-{count}-{part}" for part in range(len(specs))]
        for place, spec in zip(places, specs, strict=True):
            self.add(place, {"": spec})
        return places

    def _static(self, name: str) -> Spec:
        """Return the specification of a figure's first choice in light colours."""
        spec = {**self.specs[name][self.chosen[name]], "config": _light()}
        return spec if is_vega(spec) else {**spec, "datasets": self.data}

    def png(self, name: str, scale: float) -> bytes:
        """Return a figure as a PNG file."""
        spec = self._static(name)
        convert = vl_convert.vega_to_png if is_vega(spec) else vl_convert.vegalite_to_png
        return bytes(convert(spec, scale=scale))

    def picture(self, name: str, beside: int) -> str:
        """Return one of ``beside`` parts of a figure as a data URI: SVG, or a smaller JPEG if it has too many marks."""
        spec = self._static(name)
        own = spec.get("usermeta", {})
        if "square" in own:  # drawn as in charts.js
            spec |= {"width": own["square"], "height": own["square"], "autosize": "pad"}
        else:
            spec["width"] = _PAPER // beside
        kind, image = "svg+xml", b""
        if own.get("renderer") != "canvas":
            ids: dict[str, str] = {}  # Vega numbers clip paths across all figures of a process
            svg = re.sub(
                r'(?<= id=")clip\d+|(?<=url\(#)clip\d+',
                lambda found: ids.setdefault(found[0], f"clip{len(ids)}"),
                vl_convert.vegalite_to_svg(spec),
            )
            image = svg.encode()
        if not image or len(image) > _MOST_SVG:
            kind, image = "jpeg", vl_convert.vegalite_to_jpeg(spec, scale=1.5, quality=80)
        return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"

    @property
    def packed(self) -> str:
        """Return all data that the page's script needs, as JSON in zlib's format, a fifth of the size, in base64."""
        document = {"specs": self.specs, "data": self.data, "chosen": self.chosen, "look": LOOK}
        return base64.b64encode(zlib.compress(json.dumps(document).encode(), 9)).decode()

    @property
    def scripts(self) -> list[str]:
        """Return the scripts that draw the figures; empty if there are no figures."""
        return [library(), own_file("charts.js")] if self.specs else []

    @property
    def policy(self) -> str:
        """Return the page's Content-Security-Policy: it loads no resources and runs only the page's own scripts."""
        hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in self.scripts]
        allowed = " ".join(f"'sha256-{each}'" for each in hashes) or "'none'"
        return f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {allowed}"


# --- parts of specifications


def is_vega(spec: Spec) -> bool:
    """Return True for a specification of Vega, False for Vega-Lite."""
    return "/vega/" in spec["$schema"]


def chart(height: int, **parts: Any) -> Spec:
    """Return a specification as wide as the page; ``height`` in px."""
    schema, fit = "https://vega.github.io/schema/vega-lite/v6.json", {"type": "fit-x", "contains": "padding"}
    return {"$schema": schema, "width": 640, "height": height, "autosize": fit, **parts}


def number(value: float, digits: int = 5) -> float | None:
    """Return a number rounded for a page; None if it is not finite."""
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def rows(**columns: Column) -> Rows:
    """Return a data set from columns; numbers are rounded, and single values are repeated in all rows."""
    lists = {name: column.tolist() if isinstance(column, np.ndarray) else column for name, column in columns.items()}
    length = max(len(column) for column in lists.values() if isinstance(column, list))
    filled = [column if isinstance(column, list) else [column] * length for column in lists.values()]
    return [
        {name: number(value) if isinstance(value, float) else value for name, value in zip(lists, row, strict=True)}
        for row in zip(*filled, strict=True)
    ]


def quantity(field: str, title: str, **more: Any) -> Spec:
    """Return a quantitative encoding of a field."""
    return {"field": field, "type": "quantitative", "title": title, **more}


def tip(**fields: str) -> Rows:
    """Return a tooltip encoding, from titles by field."""
    return [quantity(name, title, format=".4~g") for name, title in fields.items()]


def axis_scale(*, log: bool = False, ends: Sequence[float] = ()) -> Spec:
    """Return the scale of an axis or of colours, from the smallest to the largest value, or between two ends."""
    kind: Spec = {"type": "log", "nice": False} if log else {"type": "linear", "nice": False, "zero": False}
    return kind | ({"domain": [number(end, 6) for end in ends]} if len(ends) else {})
