# SPDX-License-Identifier: Apache-2.0
"""pymcap-cli, a checker of MCAP files by others, finds no fault in a bag."""

import json

import pytest
from cells import scenario

from lathe_rc import harness
from lathe_rc.bag.repairing.recover import recover
from uv import uv

pytestmark = pytest.mark.system

RECORDER = {"mode": "both", "split_duration": 0.1, "pre": 0.05, "post": 0.05, "triggers": ["learning_controller: *"]}


@pytest.mark.parametrize("mode", ["offline", "processes"])
def test_the_doctor_finds_no_fault(mode, tmp_path):
    """In whole and split bags, snapshots and recovered bags."""
    events = {"events": ["revolution 2: freeze"]}
    nodes = scenario(spindle_encoder={"revolutions": 4.0}, learning_controller=events, recorder=RECORDER)
    result = harness.run(nodes, mode=mode, bag=tmp_path / "bag")
    recover(result.bag, tmp_path / "saved")
    files = sorted(tmp_path.glob("**/*.mcap"))
    assert len(files) > 4
    for file in files:
        said = uv("tool", "run", "--quiet", "pymcap-cli==0.34.0", "doctor", "--format", "jsonl", file, check=False)
        found = [json.loads(line) for line in said.splitlines()]
        assert [each for each in found if each.get("severity") in ("warning", "error")] == []
        assert found[-1]["complete"]
