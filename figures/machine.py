# SPDX-License-Identifier: Apache-2.0
"""Draws img/machine.svg of index.md and README.md: a lathe for pistons, seen along its spindle, and its control loop.

All colours can be read on a light and on a dark page.
"""

import math

from place import PICTURES, drawing

WIDTH, HEIGHT = 712, 316
X, Y = 150, 138  # centre of the part
RING, LONG, SHORT = 110, 84, 70  # radii: of the encoder's disc, of the part along both axes, which are exaggerated
TICKS = 72
STYLE = """
  text { font-family: system-ui, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
  .box { fill: #e4f0f3; stroke: #1f6f8b; stroke-width: 1.5; }
  .drive { fill: #fbecd9; stroke: #b5651d; stroke-width: 1.5; }
  .tool { fill: #7f8c92; stroke: none; }
  .part { fill: #cfd8dc; stroke: #546e7a; stroke-width: 2; }
  .mean { fill: none; stroke: #546e7a; stroke-width: 1; stroke-dasharray: 4 4; }
  .ring { fill: none; stroke: #1f6f8b; stroke-width: 1.5; }
  .name { font-weight: 600; font-size: 14px; fill: #0f3542; text-anchor: middle; }
  .what { font-size: 12px; fill: #33505a; text-anchor: middle; }
  .caption { font-size: 12.5px; fill: #7f8c92; }
  .arrow { stroke: #7f8c92; stroke-width: 1.6; fill: none; }
"""


def box(kind: str, place: tuple[float, float, float, float], name: str, what: str) -> list[str]:
    """Return a box at left, top, width and height, with two lines of text."""
    x, y, width, height = place
    middle = x + width / 2
    return [
        f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6"/>',
        f'<text class="name" x="{middle:g}" y="{y + height / 2 - 3:g}">{name}</text>',
        f'<text class="what" x="{middle:g}" y="{y + height / 2 + 14:g}">{what}</text>',
    ]


def arrow(path: str, ends: str = "marker-end") -> str:
    """Return a line with a tip at one end or, with two markers, at both."""
    tips = " ".join(f'{end}="url(#tip)"' for end in ends.split())
    return f'<path class="arrow" d="{path}" {tips}/>'


def caption(x: float, y: float, text: str, anchor: str = "start") -> str:
    """Return a caption."""
    return f'<text class="caption" x="{x:g}" y="{y:g}" text-anchor="{anchor}">{text}</text>'


def disc() -> list[str]:
    """Return the disc of the encoder with its ticks, and the part within it."""
    ticks = []
    for number in range(TICKS):
        angle = 2 * math.pi * number / TICKS
        inner, outer = (RING - (12 if number == 0 else 7), RING)
        ends = [(X + radius * math.cos(angle), Y + radius * math.sin(angle)) for radius in (inner, outer)]
        (x1, y1), (x2, y2) = ends
        ticks.append(f"M {x1:.1f} {y1:.1f} L {x2:.1f} {y2:.1f}")
    return [
        f'<circle class="ring" cx="{X}" cy="{Y}" r="{RING}"/>',
        f'<path class="ring" d="{" ".join(ticks)}"/>',
        f'<ellipse class="part" cx="{X}" cy="{Y}" rx="{LONG}" ry="{SHORT}"/>',
        f'<circle class="mean" cx="{X}" cy="{Y}" r="{(LONG + SHORT) / 2:g}"/>',
        f'<text class="name" x="{X}" y="{Y - 4}">part</text>',
        f'<text class="what" x="{X}" y="{Y + 13}">oval, exaggerated</text>',
    ]


def picture() -> str:
    """Return the picture."""
    edge = X + LONG
    drawn = [
        *disc(),
        caption(X, 18, "spindle with encoder", "middle"),
        arrow(f"M {X - 40} {Y - 40} A 57 57 0 0 1 {X + 40} {Y - 40}"),
        f'<path class="tool" d="M {edge} {Y} L {edge + 30} {Y - 13} H {edge + 62} V {Y + 13} H {edge + 30} Z"/>',
        caption(edge + 34, Y - 20, "tool"),
        *box("drive", (edge + 62, Y - 27, 116, 54), "piezo drive", "fine: µm"),
        *box("drive", (edge + 182, Y - 27, 182, 54), "electrodynamic drive", "coarse: mm"),
        *box("box", (edge + 368, Y - 40, 92, 80), "slide", "feed"),
        arrow(f"M {edge + 110} {Y - 42} H {edge + 316}", "marker-start marker-end"),
        caption(edge + 213, Y - 52, "in and out, twice a revolution", "middle"),
        *box("box", (edge + 30, 248, 360, 56), "controllers", "learn the error of each revolution, correct the next"),
        arrow(f"M {X} {Y + RING + 2} V 276 H {edge + 27}"),
        caption(X + 8, 293, "angle, speed"),
        arrow(f"M {edge + 48} {Y + 14} V 245"),
        caption(edge + 54, 212, "form error"),
        arrow(f"M {edge + 134} 247 V {Y + 30}"),
        arrow(f"M {edge + 273} 247 V {Y + 30}"),
        caption(edge + 204, 212, "commands", "middle"),
    ]
    return drawing("machine.py", WIDTH, HEIGHT, STYLE, drawn)


if __name__ == "__main__":
    (PICTURES / "machine.svg").write_text(picture(), encoding="utf-8")
