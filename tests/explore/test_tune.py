# SPDX-License-Identifier: Apache-2.0
"""Tuning: search spaces, objectives, searches that are reproducible however they are computed, and results."""

import json
import math
from pathlib import Path

import numpy as np
import optuna
import pytest
from click.testing import CliRunner
from machines import assert_refused
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

import lathe_explore
from lathe_explore.commands import progress
from lathe_explore.sweep import formulas, history, row, sweep, tune
from lathe_explore.sweep.objectives import objectives
from lathe_explore.sweep.search_space import Dimension, search_space
from lathe_explore.sweep.space import Space
from lathe_machine.analysis.pid_tuning import evaluate
from lathe_machine.control.decoupler import PAPER
from lathe_machine.control.pid import PidGains
from lathe_rc import cli, harness, resources
from lathe_rc.cell import batch, scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

LEAD, Q = "learning_controller.lead_time", "learning_controller.q_time"
FREE = {LEAD: "0.8e-3:2e-3", Q: "40e-6:300e-6:log"}
ERROR = "longitudinal/command.error:rms"
PID = [f"force_controller.{name}" for name in ("proportional", "integral", "derivative", "derivative_filter")]


def load(name, revolutions, *overrides):
    path = resources.find(Path(f"{name}.yaml"))
    return scenario.load(path, [f"spindle_encoder.revolutions={revolutions}", *overrides])


@pytest.fixture(scope="module")
def piston():
    return load("piston", 3, f"{LEAD}=0.9e-3", f"{Q}=200e-6")


WITH = {"subjects": ["margin>=0.1"], "batch": 4}


@pytest.fixture(scope="module")
def search(piston, client, tmp_path_factory):
    """Search the piston's lead and Q in a folder of this module, given by its name."""
    place = tmp_path_factory.mktemp("tune")

    def go(folder, trials, goals=("tool.rms_error",), *, free=FREE, **more):
        return lathe_explore.tune(piston, free, list(goals), place / folder, trials=trials, client=client, **more)

    return go


def outcomes(tuning):
    """The trials as texts, in which NaN equals NaN."""
    return [repr((trial.number, dict(trial.values), trial.score)) for trial in tuning.trials]


class TestAsking:
    @pytest.mark.parametrize(
        ("free", "said"),
        [
            ({}, "nothing is free"),
            ({"learning_controller.lead_tim": "1:2"}, "unknown parameter; did you mean lead_time"),
            ({LEAD: "1e-3:1e-3"}, "an empty range; allowed: LOW below HIGH"),
            ({LEAD: "0.0:2e-3:log"}, "ends above 0"),
            ({LEAD: "1e-3:2e-3:5"}, "allowed: LOW:HIGH, LOW:HIGH:log, or values between commas"),
            ({LEAD: "0.9e-3"}, "one value is no choice"),
            ({LEAD: "1.2e-3:2e-3"}, "= 0.0009 is where the search starts, outside of 1.2e-3:2e-3"),
            ({LEAD: "-1.0:2e-3"}, "lead_time = -1.0; allowed: a finite number"),
            ({"learning_controller.lead_law": "variable,late"}, "lead_law = 'late'; allowed: one of"),
            ({"learning_controller.points_per_revolution": "512.5:2048"}, "allowed: whole numbers"),
        ],
    )
    def test_what_cannot_be_searched_is_refused_in_one_line(self, piston, free, said):
        assert_refused(lambda: search_space(piston, free), rf"^.*{said}.*$")

    def test_a_range_in_percent_is_of_the_start(self, piston):
        found = search_space(piston, {LEAD: "50%:200%"})[LEAD].distribution
        assert (found.low, found.high) == pytest.approx((0.45e-3, 1.8e-3))

    @pytest.mark.parametrize(
        ("goals", "subjects", "said"),
        [
            ([], [], "no goal; allowed: --goal COLUMN"),
            (["tool.max_eror"], [], "no such column; did you mean tool.max_error"),
            (["tool.max_error", "-tool.max_error"], [], "a goal is given twice"),
            (["coarse/state.effort:top"], [], "no statistic 'top'; allowed: max"),
            (["tool.max_error"], ["margin=0.2"], "allowed: COLUMN>=NUMBER or COLUMN<=NUMBER"),
            (["tool.max_error"], ["margin>=much"], "'much' is no number"),
            (["tool.max_error"], ["margn>=0.2"], "no such column; did you mean margin"),
        ],
    )
    def test_what_cannot_be_wanted_is_refused_in_one_line(self, piston, goals, subjects, said):
        assert_refused(lambda: objectives(piston, goals, subjects), rf"^.*{said}.*$")

    @pytest.mark.parametrize(
        ("goal", "why"), [("tool.max_error", "there is no tool"), ("-margin", "there is no learning controller")]
    )
    def test_a_column_that_a_cell_never_has_is_refused(self, goal, why):
        assert_refused(lambda: objectives(load("interrupted_cut", 3), [goal]), f"{why} in interrupted_cut")

    def test_the_command_refuses_in_one_line(self, command):
        refused = command("--worst")
        assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
        assert "--worst of one cell; allowed: with --over or --seeds" in refused.stderr

    @pytest.mark.parametrize(
        ("more", "said"),
        [
            ({"sampler": "cma"}, "sampler 'cma'; did you mean cmaes"),
            ({"sampler": "cmaes", "goals": ["tool.max_error", "-margin"]}, "cmaes with 2 goals"),
            ({"trials": 0}, "trials = 0; allowed: from 1"),
            ({"over": Space(grid={LEAD: "1e-3,2e-3"})}, "free, and what the goal is over as well"),
            ({"percentile": 0.0}, "percentile 0; allowed: above 0 up to 100"),
        ],
    )
    def test_a_search_that_cannot_be_is_refused_before_anything_is_written(self, piston, tmp_path, more, said):
        goals = more.pop("goals", ["tool.max_error"])
        assert_refused(lambda: lathe_explore.tune(piston, FREE, goals, tmp_path / "x", **more), said)
        assert not (tmp_path / "x").exists()


class TestScore:
    def cells(self, *errors, margin=0.3):
        """Rows of cells that ran to their ends."""
        return [{"status": row.DONE, "tool.max_error": error, "margin": margin} for error in errors]

    def test_the_worst_or_a_percentile_of_the_cells_counts(self, piston):
        cells = self.cells(*(1e-6 * k for k in range(1, 101)))
        for percentile, cost in ((100.0, 100e-6), (95.0, 95e-6), (50.0, 50e-6)):
            score = objectives(piston, ["tool.max_error"], percentile=percentile).score(cells)
            assert score.costs == pytest.approx((cost,))
        # With a minus a goal is to be large, and its smallest counts.
        cells = self.cells(1e-6, margin=0.3) + self.cells(1e-6, margin=0.1)
        score = objectives(piston, ["-margin"]).score(cells)
        assert (score.costs, score.margin) == ((-0.1,), 0.1)

    def refused(self, margin):
        return {"status": row.REFUSED, "tool.max_error": None, "margin": margin}

    def test_refused_and_diverged_cells_are_infeasible_the_more_the_farther_they_are(self, piston):
        wanted = objectives(piston, ["tool.max_error"], ["margin>=0.2"])
        near, far = (wanted.score([self.refused(margin), *self.cells(1e-6)]) for margin in (-0.01, -0.5))
        assert near.costs == far.costs == (math.inf,)
        assert not near.feasible
        assert all(a < b for a, b in zip(near.violations, far.violations, strict=True))
        assert wanted.score(self.cells(1e-6)).feasible
        no_value = [{**cell, "tool.in_tolerance_from": None} for cell in self.cells(1e-6)]
        assert not objectives(piston, ["tool.in_tolerance_from"]).score(no_value).feasible

    def test_a_percentile_leaves_out_so_many_that_are_refused(self, piston):
        wanted = objectives(piston, ["tool.max_error"], ["margin>=0.2"], percentile=95.0)
        for done, feasible in ((95, True), (94, False)):
            rows = [*self.cells(*[1e-6] * done), *[self.refused(-1.0)] * (100 - done)]
            assert wanted.score(rows).feasible == feasible


@pytest.fixture(scope="module")
def tuned(search):
    """A search without an interruption."""
    return search("whole", 20, **WITH)


class TestSearch:
    def test_the_best_is_better_than_start_and_formulas_and_meets_the_subjects(self, tuned):
        start, formula, best = tuned.start, tuned.by_formula, tuned.best
        assert best.score.feasible
        assert best.score.margin >= 0.1
        assert best.score.costs <= min(start.score.costs, formula.score.costs)
        assert start.values == {LEAD: 0.9e-3, Q: 200e-6}
        feasible = [trial.score.costs[0] for trial in tuned.trials if trial.score.feasible]
        assert best.score.costs[0] == min(feasible)
        assert scenario.load(tuned.folder.path / "best.yaml").identity == tuned.scenario(best).identity

    def test_each_trial_is_a_row_that_runs_again_to_its_digest(self, tuned):
        rows = tuned.sweep.table().select(["cell", *FREE]).to_pylist()
        assert rows == [{"cell": number, **trial.values} for number, trial in enumerate(tuned.trials)]
        best = tuned.best.number
        again = harness.run(tuned.sweep.scenario(best))
        assert row.digest(again.recording, []) == tuned.sweep.row(best)["digest"]

    def test_the_same_call_computes_nothing_and_gives_the_same(self, tuned, search):
        events = []
        again = search("whole", 20, **WITH, watch=lambda event: events.append(event["event"]))
        assert events == ["began"]
        assert outcomes(again) == outcomes(tune.load(tuned.folder.path)) == outcomes(tuned)

    def test_stopped_anywhere_and_begun_again_it_is_the_same_search(self, tuned, search, monkeypatch):
        """The search is stopped after some rows, and in the middle of asking; computed rows are kept."""
        seen, stops = [], {"asked": {3, 20, 30}, "rows": {2, 7, 12}}
        suggest = Dimension.suggest

        def note(event):
            seen.append(event)
            if seen.count(event) in stops.get(event, ()):
                raise KeyboardInterrupt

        def stop(free, trial, target):
            note("asked")
            suggest(free, trial, target)

        monkeypatch.setattr(Dimension, "suggest", stop)
        for _ in range(6):
            with pytest.raises(KeyboardInterrupt):
                search("stopped", 20, **WITH, watch=lambda event: note(event["event"]))
        found = search("stopped", 20, **WITH)
        assert outcomes(found) == outcomes(tuned)
        rows = tuned.sweep.table().drop_columns(["seconds"])
        assert found.sweep.table().drop_columns(["seconds"]).equals(rows)

    def test_one_program_at_a_time_computes_into_a_folder(self, search):
        def beside(_event):
            assert_refused(lambda: search("beside", 4), "another program computes into it; allowed: one at a time")

        search("beside", 4, watch=beside)

    @pytest.fixture
    def journal(self, tuned, tmp_path):
        """The journal of a copy without rows."""
        for name in ("sweep.json", "scenario.yaml", "trials.log"):
            (tmp_path / name).write_bytes((tuned.folder.path / name).read_bytes())
        return tmp_path / "trials.log"

    @pytest.mark.parametrize(
        "line", [b"{broken", b"null", b"[]", b"{}", b'{"op_code":99,"worker_id":"x"}', b'{"op_code":4}', b"\xff"]
    )
    def test_a_journal_of_something_else_is_one_line(self, journal, line):
        journal.write_bytes(line + b"\n")
        with pytest.raises(InputError, match=r"^.*trials\.log, line 1: no journal of Optuna, or damaged.*$"):
            tune.load(journal.parent)

    def test_an_incomplete_last_line_is_left_out_and_reported(self, tuned, journal, capsys):
        lines = journal.read_bytes().splitlines(keepends=True)
        last = max(number for number, line in enumerate(lines) if b'"op_code":6' in line)
        journal.write_bytes(b"".join(lines[:last]) + lines[last][:-30])
        assert outcomes(tune.load(journal.parent)) == outcomes(tuned)[:-1]
        assert f"{journal}: the last line is not whole" in capsys.readouterr().err

    def test_a_trial_of_another_program_is_refused(self, journal):
        storage = JournalStorage(JournalFileBackend(str(journal)))
        study = optuna.load_study(study_name="tuning", storage=storage)
        study.add_trial(optuna.create_trial(value=0.0))
        assert_refused(lambda: tune.load(journal.parent), r"trials\.log: trial 20 is another program's")

    def test_a_folder_holds_one_tuning_and_no_sweep(self, tuned, piston, search, client):
        with pytest.raises(InputError, match="holds a tuning; allowed: a new folder"):
            lathe_explore.run_sweep(piston, Space(grid={LEAD: [1e-3]}), tuned.folder.path, client=client)
        with pytest.raises(InputError, match=r'holds a tuning with goals \["tool.rms_error"\], not \["margin"\]'):
            search("whole", 20, ["margin"])

    def test_choices_and_whole_numbers_are_searched(self, search):
        free = {
            "learning_controller.lead_law": "constant_angle,variable",
            "learning_controller.points_per_revolution": "1024,2048",
            "learning_controller.soft_start": [0.0, 1.0],
            "learning_controller.feedback_delay": "2000:3200",
        }
        found = search("choices", 8, free=free)
        values = found.trials[-1].values
        assert [type(values[target]) for target in free] == [str, int, float, int]
        assert found.start.score.feasible
        assert len({repr(trial.values) for trial in found.trials}) > 4

    @pytest.mark.parametrize("sampler", ["cmaes", "nsga2"])
    def test_other_samplers_go_on_where_they_were_stopped(self, search, sampler):
        whole = search(sampler, 16, sampler=sampler)
        search(f"{sampler} in parts", 8, sampler=sampler)
        assert outcomes(search(f"{sampler} in parts", 16, sampler=sampler)) == outcomes(whole)
        assert whole.best.score.costs < whole.start.score.costs

    def test_two_goals_give_a_front_and_a_file_of_each(self, search):
        found = search("front", 16, ["tool.rms_error", "-margin"])
        front = found.front
        assert len(front) > 1
        for trial in front:
            written = scenario.load(found.folder.path / "front" / f"trial-{trial.number}.yaml")
            assert written.identity == found.scenario(trial).identity
        costs = np.array([trial.score.costs for trial in front])
        assert (np.diff(costs, axis=0) * (1.0, -1.0) > 0.0).all()
        feasible = [trial.score.costs for trial in found.trials if trial.score.feasible]
        assert not any(a <= c and b <= d and (a, b) != (c, d) for c, d in costs for a, b in feasible)
        assert found.best in front

    def test_the_goal_over_plants_is_that_of_the_worst(self, search):
        over = Space(sampled={"electrodynamic_actuator.natural_frequency": "uniform:90%:110%"}, sample="sobol:4")
        found = search("plants", 3, over=over)
        table = found.sweep.table()
        assert table.num_rows == 12
        for trial in found.trials:
            cells = table.slice(4 * trial.number, 4).column("tool.rms_error").to_pylist()
            assert trial.score.costs == (math.inf if None in cells else max(cells),)
        plants = table.column("electrodynamic_actuator.natural_frequency").to_pylist()
        assert plants[:4] == plants[4:8] == plants[8:]

    def test_a_cell_without_a_tool_is_tuned_by_what_is_measured_in_its_last_revolution(self, client, tmp_path):
        cut = load("interrupted_cut", 4, f"{PID[0]}=1e-3")
        free, options = {PID[0]: "1e-4:0.05:log"}, {"trials": 3, "ask_formulas": False, "client": client}
        found = lathe_explore.tune(cut, free, [ERROR], tmp_path / "x", **options)
        again = harness.run(found.sweep.scenario(2))
        kept = found.sweep.row(2)
        assert row.digest(again.recording, found.folder.measures) == kept["digest"]
        turned = again.recording.dense["/encoder"]["angle_true"]
        error = again.recording.dense["/longitudinal/command"]["error"]
        last = error[(turned >= 6 * np.pi) & (turned < 8 * np.pi)]
        assert kept[ERROR] == pytest.approx(math.sqrt(np.mean(last**2)), rel=1e-3)


def factor(scenario):
    """The largest factor of learning from cycle to cycle."""
    cell = Cell(scenario.nodes)
    cell.check()
    return cell.factors["learning_controller"]


class TestFormulas:
    @pytest.mark.parametrize("margin", [0.05, 0.2])
    def test_q_time_keeps_the_margin_and_is_the_shortest_that_does(self, piston, margin):
        found = formulas.settings(piston, [LEAD, Q, "learning_controller.learning_gain"], margin)
        values = {target: each.value for target, each in found.items()}
        assert values["learning_controller.learning_gain"] == 1.0
        assert 1.0 - factor(piston.varied(values)) == pytest.approx(margin, abs=1e-4)
        assert 1.0 - factor(piston.varied({**values, Q: 0.98 * values[Q]})) < margin

    def test_the_lead_is_the_drive_s_lag(self, piston):
        drive = piston.nodes["electrodynamic_actuator"]
        lag = 2.0 * drive.damping / drive.natural_frequency + drive.delay
        assert formulas.settings(piston, [LEAD, Q])[LEAD].value == pytest.approx(lag, rel=1e-3)
        assert formulas.settings(piston, ["tool.feed", "learning_controller.soft_start"]) == {}

    def test_with_a_given_q_the_lead_has_the_largest_margin(self, piston):
        lead = formulas.settings(piston, [LEAD])[LEAD].value
        at_lead, shorter, longer = (factor(piston.varied({LEAD: part * lead})) for part in (1.0, 0.97, 1.03))
        assert at_lead < min(shorter, longer)

    def test_the_force_loop_has_the_margins_that_are_said(self):
        """The loop has W1 as paper 004 prints it, and a feedback delay of 1 ms."""
        found = formulas.settings(load("force_turning", 3), PID)
        loop = evaluate(PAPER.w1, PidGains(*(found[target].value for target in PID)), 64 / 64_000)
        assert loop.stable
        assert math.degrees(loop.phase_margin) == pytest.approx(60.0, abs=3.0)
        assert loop.gain_margin > 2.0


def test_the_robust_setting_of_the_page_is_twice_as_good_on_the_worst_plant_as_the_nominal_one():
    """A setting tuned over 64 plants leaves less than half of what the nominal optimum does on the worst of them."""
    two_channel = load("two_channel", 30)
    plants = Space(
        sampled={
            "electrodynamic_actuator.natural_frequency": "uniform:90%:110%",
            "electrodynamic_actuator.damping": "uniform:90%:110%",
            "piezo_actuator.natural_frequency": "uniform:95%:105%",
            "piezo_actuator.damping": "uniform:90%:110%",
        },
        sample="sobol:64",
    )
    names = (LEAD, Q, "fine_controller.lead_time", "fine_controller.q_time")
    nominal = dict(zip(names, (1.28459e-3, 216.231e-6, 91.674e-6, 13.5154e-6), strict=True))
    robust = dict(zip(names, (1.7713e-3, 139.249e-6, 92.5337e-6, 9.94758e-6), strict=True))

    def worst(setting, plants):
        cells = (two_channel.varied({**setting, **plant}) for plant in plants)
        return max(outcome.kept.largest[-1] for outcome in batch.run_many(cells, batch.Errors))

    plants = list(plants.cells(two_channel))
    # The nominal setting is worst on plant 37. That one alone shows what it leaves at least, and halves the time.
    assert worst(robust, plants) < 0.5 * worst(nominal, plants[37:38])


@pytest.fixture
def command(tmp_path, monkeypatch, client):
    """Run ``lathe tune piston`` in this process."""
    monkeypatch.setattr(sweep, "client_of", lambda *_: sweep.nullcontext(client))

    def run(*words):
        asked = ["tune", "piston", "--free", f"{LEAD}=0.8e-3:2e-3", "--goal", "tool.max_error"]
        return CliRunner().invoke(cli.main, [*asked, "--out", str(tmp_path / "x"), *words])

    return run


def test_the_command_shows_and_writes_what_it_found(tmp_path, command):
    folder = tmp_path / "x"
    asked = ["--revolutions", "3", "--set", f"{LEAD}=0.9e-3", "--over", "seed=0,1", "--sample", "sobol:2"]
    asked += ["--over", "electrodynamic_actuator.damping=uniform:95%:105%", "--percentile", "50", "--trials", "3"]
    shown = command(*asked)
    assert shown.exit_code == 0, shown.output
    assert "by formula, learning_controller.lead_time: T0 with the least sup|Q - γZ|" in shown.stdout
    assert f"best:    lathe run {folder / 'best.yaml'}" in shown.stdout
    assert (folder / "history.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads(command(*asked, "--json").stdout)
    assert (told["trials"], told["cells"], told["best"]["feasible"]) == (3, 4, True)
    assert told["best"]["goals"]["tool.max_error"] <= told["start"]["goals"]["tool.max_error"]


def test_where_nothing_runs_the_command_says_why(command, monkeypatch):
    monkeypatch.setattr(history, "write", lambda found: found.folder.path / "history.png")
    shown = command("--set", "spindle_encoder.revolutions=0.0", "--trials", "2")
    assert "nothing meets all subjects; allowed: wider ranges" in shown.stdout
    assert "2 cells did not run to their end, as this one: spindle_encoder" in shown.stdout


def test_ctrl_c_says_what_is_kept(tmp_path, command, monkeypatch):
    def stop(watch, event):
        take(watch, event)
        if event["event"] == "told":
            raise KeyboardInterrupt

    take = progress.SweepWatch.__call__
    monkeypatch.setattr(progress.SweepWatch, "__call__", stop)
    stopped = command("--revolutions", "3", "--trials", "20", "--batch", "2")
    assert stopped.exit_code == 130
    assert f"lathe: stopped; 2 of 20 trials are in {tmp_path / 'x'}: the same command goes on" in stopped.stderr
