# SPDX-License-Identifier: Apache-2.0
"""``lathe bench``: the frame around the benchmarks. Their figures depend on the machine and are not tested."""

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from lathe_rc import harness

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import engine, page, ros, sides, suite, transport
from benchmarks.__main__ import main

RESULT = {
    "commit": "abc",
    "quick": False,
    "machine": {"processor": "a processor", "cores": 2, "system": "Linux", "python": "3.11"},
    "engine": {
        "c_ratio": {"median": 0.95, "low": 0.9, "high": 1.0, "runs": 3},
        "target_c_ratio": 0.9,
        "real_time_factor": {"median": 140.0, "low": 120.0, "high": 160.0, "runs": 3},
        "target_real_time_factor": 150.0,
        "full_cell": {
            "c_ratio": {"median": 0.5, "low": 0.4, "high": 0.6, "runs": 3},
            "target_c_ratio": 0.85,
            "ns_per_sample": {"engine": {"median": 300.0, "low": 300.0, "high": 300.0, "runs": 3}},
        },
        "took_s": 1.0,
    },
    "ros": {
        "piston_5_nodes": {"block_64": {"processes": {"real_time_factor": 4.0, "target_real_time_factor": 3}}},
        "bare_transport": {"block_64": {"bare_transport_ratio": 0.45, "target_bare_transport_ratio": 0.6}},
        "took_s": 1.0,
    },
}


def run(*arguments):
    return CliRunner().invoke(main, ["bench", *arguments])


def test_sides_take_turns_and_their_rounds_belong_together():
    order = []
    counts = {"a": iter([1.0, 2.0, 4.0]), "b": iter([2.0, 2.0, 2.0])}

    def side(name):
        def ask():
            order.append(name)
            return next(counts[name])

        return ask

    found = sides.alternate({name: side(name) for name in counts}, 3)
    assert order == ["a", "b"] * 3
    assert sides.ratio(found["a"], found["b"]) == {"median": 1.0, "low": 0.5, "high": 2.0, "runs": 3}


def test_results_are_kept_by_commit_and_parts_are_added(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "STORE", tmp_path)
    path = suite.store(RESULT)
    suite.store({"commit": "abc", "quick": False, "start": {"offline_s": 2.0}})
    kept = json.loads(path.read_text())
    assert path.name == "abc.json"
    assert set(kept) >= {"engine", "start"}
    assert suite.figures(kept)["engine.c_ratio"] == 0.95


def test_a_stored_result_is_shown_beside(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "run", lambda *_, **__: {**RESULT, "commit": "def"})
    monkeypatch.setattr(suite, "STORE", tmp_path)
    old = tmp_path / "old.json"
    old.write_text(json.dumps({**RESULT, "engine": {"c_ratio": 0.5}}))
    shown = run("engine", "--against", str(old))
    assert shown.exit_code == 0, shown.output
    assert "1.9" in next(line for line in shown.output.splitlines() if "engine.c_ratio" in line)
    assert json.loads(run("engine", "--json").output)["engine"]["c_ratio"]["median"] == 0.95


def test_a_law_and_a_drive_of_a_user_are_measured_beside_ours(tmp_path, monkeypatch):
    """Within the command, where no code of others is allowed by itself."""
    monkeypatch.setattr(suite, "STORE", tmp_path)
    monkeypatch.setattr(engine, "measure", lambda *, quick, **_: {"own": engine.own(quick=quick)})
    monkeypatch.setattr(engine, "_asked", lambda turns, _: dict.fromkeys(turns, (1.0,)))
    shown = run("engine", "--quick", "--json")
    assert shown.exit_code == 0, shown.output
    assert json.loads(shown.output.splitlines()[-1])["engine"]["own"]["law"]["ratio_to_ours"]["median"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["engin"], "lathe bench engin; allowed: engine, batch, sweep"),
        (["--against", "no-such-commit"], "--against no-such-commit: no such file or stored commit"),
        (["--page", "no-such-commit"], "--page no-such-commit: no such file or stored commit"),
    ],
)
def test_what_is_not_there_is_one_line(arguments, words):
    refused = run(*arguments)
    assert (refused.exit_code, words in refused.output) == (2, True)


def test_the_page_has_figures_in_groups_and_says_which_targets_are_met():
    lines = page.page(RESULT).splitlines()
    for figure, found, goal in [
        ("engine.c_ratio", "0.95 (0.9 … 1)", "≥ 0.9: met"),
        ("engine.real_time_factor", "140 (120 … 160)", "≥ 150: **not met**"),
        ("engine.full_cell.c_ratio", "0.5 (0.4 … 0.6)", "≥ 0.85: **not met**"),
        ("ros.bare_transport.block_64.bare_transport_ratio", "0.45", "≥ 0.6: **not met**"),
        ("ros.piston_5_nodes.block_64.processes.real_time_factor", "4", "≥ 3: met"),
    ]:
        assert f"| `{figure}` | {found} | {goal} |" in lines
    assert {"### full cell", "### piston 5 nodes", "### bare transport"} <= {*lines}
    assert any("a processor" in line for line in lines)


@pytest.mark.system
def test_bare_transport_passes_every_message(tmp_path):
    scenario = harness.with_recorder(ros.load("piston", spindle_encoder__revolutions=1.5), tmp_path / "bag", keep=True)
    passing = transport.Transport(scenario, tmp_path)
    passed = passing.run()
    found = {topic: [] for topic in passing.sent}
    with passing.bag.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            found[channel.topic].append(message.data)
    assert found == passing.sent
    assert passed.taken == {topic: len(sent) for topic, sent in passing.sent.items()}
    assert passed.taken["/tool"] > scenario.shared.window
    assert passed.taken["/tool/joint_states"]


def test_every_part_is_there():
    for part in suite.PARTS:
        assert (suite.ROOT / "benchmarks" / f"{part}.py").is_file()
