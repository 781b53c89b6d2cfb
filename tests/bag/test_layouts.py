# SPDX-License-Identifier: Apache-2.0
"""The layouts for PlotJuggler and Foxglove draw what a recording of their demo holds, and no other motion."""

import json
import math
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from lathe_rc import harness, messages
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell.scenario import load

ROOT = Path(__file__).parents[2]
LAYOUTS = ROOT / "config" / "layouts"
DEMOS = ("piston", "two_channel")
_SAMPLE = re.compile(r"(\w+)\[(-?\d+)\]")
_STATUS = re.compile(r'status\[:\]\{name=="(.*)"\}\.values\[:\]\{key=="(.*)"\}\.value')


@pytest.fixture(scope="module", params=DEMOS)
def demo(request, tmp_path_factory):
    """Name of a demo, and by topic the messages of a short recording that lasts longer than a diagnostics period."""
    pytest.importorskip("rclpy")
    bag = tmp_path_factory.mktemp(request.param) / "bag"
    slow = ["spindle_encoder.revolutions=4", "spindle_encoder.speed_factor=0.15"]
    harness.run(load(ROOT / "config" / f"{request.param}.yaml", slow), mode="composed", bag=bag)
    found = {}
    with BagSource(bag) as source:
        for topic, _, data in source.messages():
            found.setdefault(topic, []).append(messages.decode(source.topics[topic].type, data))
    return request.param, found


def numbers(values):
    return [float(value) for value in values if math.isfinite(float(value))]


def of_samples(recorded, topic, field, place):
    """The last sample of each block, by either name; lines between them show the motion of the signal."""
    blocks = [np.asarray(getattr(message, field)) for message in recorded[topic]]
    assert place in (-1, blocks[0].size - 1)
    signal, ends = np.concatenate(blocks), np.cumsum([block.size for block in blocks]) - 1
    drawn = np.interp(np.arange(signal.size), ends, signal[ends])[ends[0] :]
    assert np.std(drawn - signal[ends[0] :]) <= 0.5 * np.std(signal), f"{topic}.{field} is drawn too rarely"
    return numbers(signal[ends])


def of_status(recorded, hardware, name, key):
    """Values of a key in the diagnostics of a node; any hardware if it is None."""
    found = [status for array in recorded["/diagnostics"] for status in array.status if status.name == name]
    assert hardware is None or {status.hardware_id for status in found} == {hardware}
    return numbers(pair.value for status in found for pair in status.values if pair.key == key)


def of_field(recorded, topic, field):
    return numbers(getattr(message, field) for message in recorded[topic])


def plotjuggler(recorded, curve):
    """The values that PlotJuggler draws as a curve of this name."""
    if curve.startswith("/diagnostics/"):
        hardware, name, key = re.fullmatch(r"/diagnostics/(\w+)/(/\w+)/(.*)", curve).groups()
        return of_status(recorded, hardware, name, key)
    topic, field = curve.rsplit("/", 1)
    if sample := _SAMPLE.fullmatch(field):
        return of_samples(recorded, topic, sample[1], int(sample[2]))
    return of_field(recorded, topic, field)


def foxglove(recorded, path):
    """The values of a Foxglove message path."""
    topic, _, rest = path.partition(".")
    if status := _STATUS.fullmatch(rest):
        return of_status(recorded, None, *status.groups())
    if sample := _SAMPLE.fullmatch(rest):
        return of_samples(recorded, topic, sample[1], int(sample[2]))
    return of_field(recorded, topic, rest)


def leaves(layout):
    return [layout] if isinstance(layout, str) else [*leaves(layout["first"]), *leaves(layout["second"])]


def test_plotjuggler_draws_only_what_is_recorded(demo):
    name, recorded = demo
    root = ET.parse(LAYOUTS / f"plotjuggler_{name}.xml").getroot()  # noqa: S314 - a file of our own
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert [curve for curve in curves if not plotjuggler(recorded, curve)] == []
    learning = {curve for curve in curves if "/learning/" in curve}
    channels = {topic for topic in recorded if topic.endswith("/learning")}
    assert {curve.rsplit("/", 1)[0] for curve in learning} == channels


def test_foxglove_draws_only_what_is_recorded(demo):
    name, recorded = demo
    layout = json.loads((LAYOUTS / f"foxglove_{name}.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    assert [path for path in paths if not foxglove(recorded, path)] == []
    drives = {path.partition(".")[0] for path in paths if "/state." in path}
    assert drives == {topic for topic in recorded if topic.endswith("/state")}
    assert {panel["topicToRender"] for panel in panels.values() if "topicToRender" in panel} <= set(recorded)


@pytest.mark.parametrize("name", DEMOS)
def test_splitters_say_how_many_parts_they_have(name):
    root = ET.parse(LAYOUTS / f"plotjuggler_{name}.xml").getroot()  # noqa: S314 - a file of our own
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))
    assert len(root.findall("tabbed_widget/Tab")) == 3
