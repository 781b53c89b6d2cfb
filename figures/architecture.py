# SPDX-License-Identifier: Apache-2.0
"""Draws img/architecture.svg of index.md: the packages in layers, and who imports whom.

tests/repository/test_site.py compares the picture with the imports in the code.
"""

from typing import NamedTuple

from place import PICTURES, drawing


class Layer(NamedTuple):
    """Boxes side by side, by package, with what is in them."""

    caption: str
    boxes: dict[str, str]


#: Who is in a layer imports from it and from those below.
LAYERS = (
    Layer(
        "other packages",
        {
            "lathe_bagtools": "replay, resim",
            "lathe_commission": "fit, design",
            "lathe_explore": "sweep, tune",
            "lathe_export": "tables, C, FMU",
            "lathe_live": "panel, Rerun",
        },
    ),
    Layer(
        "the machine",
        {"lathe_machine": "spindle, learning, drives, cut, tool, feed, supervisor: physics, laws, stages"},
    ),
    Layer("command line", {"commands": "lathe run, bag, report, …"}),
    Layer("Python", {"harness": "runs a scenario, scores it"}),
    Layer("hosts", {"nodes": "ROS 2 nodes, processes, DDS"}),
    Layer("to look at", {"view": "report, figures, notebooks"}),
    Layer(
        "beside the cell",
        {
            "bag": "MCAP: record, read, repair",
            "protocol": "joining, progress, the end",
        },
    ),
    Layer("judgement", {"judge": "part, loops, budget, against tolerances"}),
    Layer("the framework", {"cell": "wiring, scenario, stage, checks, offline run"}),
    Layer("between nodes", {"blocks": "ports, messages as arrays and bytes, delays"}),
    Layer(
        "around it",
        {
            "drawing": "pages, charts, pictures",
            "analysis": "form, loops, responses",
        },
    ),
    Layer("signals", {"signals": "speed, noise, measured data", "safety": "faults, states"}),
    Layer("compiled code", {"compiled": "memories and addresses of steps"}),
)
#: Arrows within a layer.
BESIDE: tuple[tuple[str, str], ...] = ()

LEFT, WIDTH, RIGHT = 112, 640, 4
HEIGHT, GAP, SPACE = 50, 22, 36  # of a box, between layers, between boxes
TOP = 12
STYLE = """
  text { font-family: system-ui, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
  .box { fill: #e4f0f3; stroke: #1f6f8b; stroke-width: 1.5; }
  .ros { fill: #fbecd9; stroke: #b5651d; }
  .name { font-weight: 600; font-size: 15px; fill: #0f3542; }
  .what { font-size: 12px; fill: #33505a; }
  .caption { font-size: 12.5px; fill: #7f8c92; }
  .arrow { stroke: #7f8c92; stroke-width: 1.6; fill: none; }
"""


def places() -> dict[str, tuple[float, float, float]]:
    """Return left end, top and width of each box."""
    found = {}
    for row, layer in enumerate(LAYERS):
        space = SPACE if len(layer.boxes) < 4 else SPACE / 2
        width = (WIDTH - space * (len(layer.boxes) - 1)) / len(layer.boxes)
        for column, name in enumerate(layer.boxes):
            found[name] = (LEFT + column * (width + space), TOP + row * (HEIGHT + GAP), width)
    return found


def arrow(path: str) -> str:
    """Return an arrow along a path."""
    return f'<path class="arrow" d="{path}" marker-end="url(#tip)"/>'


def picture() -> str:
    """Return the picture."""
    found, drawn = places(), []
    for row, layer in enumerate(LAYERS):
        top = TOP + row * (HEIGHT + GAP)
        drawn.append(f'<text class="caption" x="{LEFT - 14}" y="{top + 30}" text-anchor="end">{layer.caption}</text>')
        if row:
            drawn.append(arrow(f"M {LEFT + WIDTH / 2:g} {top - GAP + 1} V {top - 3}"))
        for name, what in layer.boxes.items():
            x, y, width = found[name]
            kind, shown = "box ros" if name == "nodes" else "box", name.removeprefix("lathe_")
            drawn += [
                f'<rect class="{kind}" x="{x:g}" y="{y}" width="{width:g}" height="{HEIGHT}" rx="6"/>',
                f'<text class="name" x="{x + width / 2:g}" y="{y + 21}" text-anchor="middle">{shown}</text>',
                f'<text class="what" x="{x + width / 2:g}" y="{y + 39}" text-anchor="middle">{what}</text>',
            ]
    for start, end in BESIDE:
        (x, y, width), (other, _, _) = found[start], found[end]
        drawn.append(arrow(f"M {x + width:g} {y + HEIGHT / 2:g} H {other - 3:g}"))
    height = TOP + len(LAYERS) * (HEIGHT + GAP)
    return drawing("architecture.py", LEFT + WIDTH + RIGHT, height, STYLE, drawn)


if __name__ == "__main__":
    (PICTURES / "architecture.svg").write_text(picture(), encoding="utf-8")
