# SPDX-License-Identifier: Apache-2.0
"""Block diagram of a wired cell as an SVG: nodes in order of computation along the diagonal, topics as lines.

A topic leaves its node to the right and enters the nodes below from above; to nodes above, it leaves to the left and
enters from below. Each connection thus has a place of its own (an N² chart). Delayed connections are dotted.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell

_BOX, _PITCH, _EDGE = 122, 150, 6  # [px] width of a node, from one to the next, and margin
_LINE, _OUTPUT, _GAP = 13, 26, 26  # [px] of a text line, of an output, and between rows
_LEFT = 68  # [px] width of a node's lower edge where connections enter, beside which their delays have room
_LETTERS = 16  # in a line of a name


@dataclass(frozen=True)
class Connection:
    """Input of a node.

    Attributes:
        topic: relative name of the topic.
        source, reader: indices of the nodes.
        delay: delay [sample]; 0 for a forward edge.
        fields: fields that the reader uses.
    """

    topic: str
    source: int
    reader: int
    delay: int
    fields: tuple[str, ...]


def connections(cell: Cell) -> list[Connection]:
    """Return the inputs of all nodes, one per topic and delay."""
    places = {name: place for place, name in enumerate(cell.stages)}
    found: dict[tuple[str, int, int], list[str]] = {}
    for reader, stage in enumerate(cell.stages.values()):
        for port in stage.inputs:
            found.setdefault((remapped(stage.shared, port.topic), reader, port.delay), []).extend(port.fields)
    return [
        Connection(topic, places[cell.dense[topic].node], reader, delay, tuple(dict.fromkeys(fields)))
        for (topic, reader, delay), fields in found.items()
        if cell.dense[topic].node in places
    ]


def _lines(name: str) -> list[str]:
    """Split a name after underscores into lines that fit a box."""
    lines = [""]
    for part in name.replace("_", "_ ").split():
        if lines[-1] and len(lines[-1] + part) > _LETTERS:
            lines.append("")
        lines[-1] += part
    return [piece for line in lines for piece in (line[k : k + _LETTERS] for k in range(0, len(line), _LETTERS))]


@dataclass(frozen=True)
class _Box:
    """Place of a node; ``outputs``: height of the line of each of its topics."""

    x: float
    y: float
    height: float
    lines: list[str]
    outputs: dict[str, float]

    def centre(self) -> float:
        return self.x + _BOX / 2


def _boxes(cell: Cell) -> list[_Box]:
    found, y = [], float(_EDGE + _LINE)
    for place, stage in enumerate(cell.stages.values()):
        kind = type(stage).kind
        lines = [*_lines(stage.name), *(_lines(kind) if kind != stage.name else [])]
        topics = [topic for topic, source in cell.dense.items() if source.node == stage.name]
        height = max(len(lines) * _LINE + 12, len(topics) * _OUTPUT + 8)
        lanes = {topic: y + height * (k + 0.5) / len(topics) for k, topic in enumerate(topics)}
        found.append(_Box(_EDGE + place * _PITCH, y, height, lines, lanes))
        y += height + _GAP
    return found


def _entries(inputs: list[Connection], boxes: list[_Box]) -> dict[Connection, float]:
    """Return where connections enter their nodes; the farther a source, the farther left, so that labels are free."""
    found: dict[Connection, float] = {}
    for reader, box in enumerate(boxes):
        for above in (True, False):
            own = [each for each in inputs if each.reader == reader and (each.source < reader) == above]
            own.sort(key=lambda each: (-abs(each.source - reader), each.topic, each.delay))
            for k, each in enumerate(own):
                wide = _BOX if above else _LEFT
                found[each] = box.x + wide * (k + 1) / (len(own) + 1)
    return found


def _drawn_box(stage: Stage, box: _Box) -> Iterator[str]:
    own = len(_lines(stage.name))
    yield f'<g class="box{" learns" if stage.learns else ""}">'
    yield f'<rect x="{box.x:g}" y="{box.y:g}" width="{_BOX}" height="{box.height:g}" rx="6"/>'
    top = box.y + (box.height - len(box.lines) * _LINE) / 2 + 10
    for k, line in enumerate(box.lines):
        kind = ' class="name"' if k < own else ""
        yield f'<text{kind} x="{box.centre():g}" y="{top + k * _LINE:g}">{escape(line)}</text>'
    yield "</g>"


def _drawn_topic(topic: str, readers: list[tuple[Connection, float]], boxes: list[_Box], step: float) -> Iterator[str]:
    """Yield a topic's line and its branches; ``readers``: its connections, and where they enter."""
    source = boxes[readers[0][0].source]
    y = source.outputs[topic]
    for right in (True, False):
        own = [(each, x) for each, x in readers if (each.reader > each.source) == right]
        if not own:
            continue
        start = source.x + _BOX if right else source.x
        end = max(x for _, x in own) if right else min(x for _, x in own)
        late = all(each.delay for each, _ in own)
        yield f'<path class="line{" late" if late else ""}" d="M {start:g} {y:g} H {end:g}"/>'
        for each, x in own:
            yield from _branch(each, x, y, boxes[each.reader], step)
        place = f'x="{start + 5:g}" y="{y - 4:g}"' if right else f'x="{start - 5:g}" y="{y + 12:g}" text-anchor="end"'
        yield f'<text class="topic" {place}>{escape(topic)}</text>'


def _branch(each: Connection, x: float, y: float, box: _Box, step: float) -> Iterator[str]:
    down = each.reader > each.source
    end, tip = (box.y - 1, -7) if down else (box.y + box.height + 1, 7)
    late = " late" if each.delay else ""
    told = f"{each.topic}: {', '.join(each.fields)}"
    delay = f"{each.delay} · {each.delay * step * 1e6:.6g} µs"
    told += f"; delayed by {each.delay} samples = {each.delay * step * 1e6:.6g} µs" if each.delay else ""
    yield f"<g><title>{escape(told)}</title>"
    yield f'<path class="line{late}" d="M {x:g} {y:g} V {end + tip:g}"/>'
    yield f'<circle class="{late.strip()}" cx="{x:g}" cy="{y:g}" r="2.6"/>'
    yield f'<path class="tip{late.replace(" ", "-")}" d="M {x:g} {end:g} l -3.5 {tip} h 7 z"/>'
    if each.delay:
        yield f'<text class="delay" x="{x + 5:g}" y="{y + 12 if down else y - 4:g}">{delay}</text>'
    yield "</g>"


def block_diagram(cell: Cell) -> str:
    """Return the SVG; it takes its colours from diagram.css, inside an element of class ``diagram``."""
    boxes, inputs = _boxes(cell), connections(cell)
    entries = _entries(inputs, boxes)
    last = boxes[-1]
    width, height = last.x + _BOX + 90, last.y + last.height + _EDGE + _LINE
    size = f'viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}"'
    drawn = [f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="block diagram">']
    step = cell.master.shared.step
    for topic in dict.fromkeys(each.topic for each in inputs):
        readers = [(each, x) for each, x in entries.items() if each.topic == topic]
        drawn += _drawn_topic(topic, readers, boxes, step)
    for stage, box in zip(cell.stages.values(), boxes, strict=True):
        drawn += _drawn_box(stage, box)
    return "\n".join([*drawn, "</svg>"])
