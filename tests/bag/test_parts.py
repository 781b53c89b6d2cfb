# SPDX-License-Identifier: Apache-2.0
"""Parts of others: Q filters, speed laws, profiles, monitors and studies that stand outside of lathe_rc.

Those of figures/parts.py are what a good one looks like; those that are refused stand here.
"""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from cells import cuts, encoder, in_two, scenario, spans
from hypothesis import given
from hypothesis import strategies as st
from machines import line_of
from numpy.testing import assert_allclose

from lathe_bagtools.resimulation.resim import resimulate
from lathe_machine.control.q_filter import Exponential, Gaussian, QFilter, Weights
from lathe_machine.safety.monitors import Alarm, PlainMonitor
from lathe_machine.signals.deviation_law import DeviationLaw
from lathe_machine.signals.part_profile import PartProfile
from lathe_rc import allowed_code, extensions, harness, messages
from lathe_rc.bag import provenance
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.cell import batch
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.study import STUDIES

DOCS = Path(__file__).parents[2] / "docs"
FIGURES = DOCS.with_name("figures")
sys.path.append(str(FIGURES))

import parts  # noqa: E402 - it stands beside the page that explains it

PARTS = {
    "spindle_encoder": {"deviation_law": "parts:Chirp", "deviation_values": [0.1, 10.0, 60.0, 0.2]},
    "learning_controller": {"q_filter": "parts:Hann", "reaction_delay": 2048},
    "tool": {"profile": "parts:Lobes", "profile_values": [3.0, 100e-6, 0.01], "feed": 1e-3, "start_height": 1e-3},
    "supervisor": {
        "monitors": ["parts:Drift", "parts:Drift"],
        "monitor_signals": ["tool.measured_error", "coarse/state.measured_position"],
        "monitor_others": ["", "coarse/command.position"],
        "monitor_limits": [0.1e-6, 1.0],
        "monitor_reactions": ["freeze", "warn"],
    },
}
NAMED = ["spindle_encoder.deviation_law", "learning_controller.q_filter", "tool.profile", "supervisor.monitors"]


@pytest.fixture(autouse=True, scope="module")
def allowed(program):
    for package in ("parts", __name__, "nowhere", "test_wiring"):
        allowed_code.allow(package)


def cell(shared=None, **nodes):
    return scenario(shared, **{name: {**values, **nodes.get(name, {})} for name, values in PARTS.items()})


def refusal(node, **values):
    """The one line with which a value is refused, beside those of the parts above."""
    return line_of(lambda: Cell(cell(**{node: values}).nodes).check())


# ---- the page


def test_the_page_shows_the_parts_as_they_are():
    """The classes on docs/extending.md, and the hash of their source, are those of figures/parts.py."""
    page, source = (DOCS / "extending.md").read_text(), (FIGURES / "parts.py").read_text()
    shown = re.findall(r"^```py\n(class .*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(shown) == 4
    assert [part for part in shown if part not in source] == []
    assert extensions.source_hash("parts") in page


# ---- hosts


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run of a cell with a part of each kind, offline, and its bag."""
    path = tmp_path_factory.mktemp("parts") / "bag"
    return path, harness.run(cell(), bag=path)


@pytest.mark.parametrize(("mode", "block_size"), [("offline", 1), ("processes", 200)])
def test_every_host_and_block_size_gives_the_same_bits(recorded, tmp_path, mode, block_size):
    """A cell with parts of others has the same digests, and its bag says the same of them, in every host."""
    bag = tmp_path / "bag"
    made = cell({"block_size": block_size})
    assert harness.run(made, mode=mode, groups=in_two(made), bag=bag).digest == recorded[1].digest
    with BagSource(recorded[0]) as one, BagSource(bag) as other:
        assert provenance.origins(other.about) == provenance.origins(one.about)


def test_a_batch_gives_the_same_bits(recorded):
    keep = ["encoder", "tool", "safety", "safety/status"]
    for outcome in batch.run_many([cell(), cell()], keep):
        assert outcome.kept.digests().items() <= recorded[1].digest.items()


def test_a_re_simulation_gives_the_same_bits(recorded):
    path, result = recorded
    found = resimulate(path)
    assert (found.digest, found.different, found.warnings) == (result.digest, [], [])


def test_each_part_does_what_its_formula_says(recorded):
    result = recorded[1]
    signals, tool = encoder(result), result.recording.of_type(messages.TOOL)
    shared = cell().shared
    time = np.arange(signals["speed"].size) * shared.step
    deviation = parts.Chirp(*PARTS["spindle_encoder"]["deviation_values"]).deviation(time)
    # Linear between points 1 ms apart: off by h²/8 of the second derivative, which is below 0.1·60².
    assert_allclose(signals["speed_true"] / shared.nominal_speed - 1.0, deviation, atol=1e-6 / 8 * 0.1 * 60**2)
    height = 1e-3 + 1e-3 * signals["angle_true"] / (2 * np.pi)
    form = 100e-6 * height / 0.01 * np.cos(3.0 * signals["angle_true"])
    assert_allclose(tool["reference"], form, atol=1e-13)
    status = result.recording.sparse["/safety/status"].values
    assert (status["monitor"], status["subject"]) == (["parts:Drift"], ["tool.measured_error"])
    alarm = parts.Drift(0.1e-6, shared.step).find(0, tool["measured_error"], np.empty(0))
    assert (status["sample_index"], status["value"]) == ([alarm.place], [alarm.value])
    assert np.flatnonzero(result.recording.dense["/safety"]["reaction"])[0] == alarm.place


# ---- Q filters


@given(st.floats(0.0, 60.0), st.floats(0.0, np.pi), st.floats(0.0, 2 * np.pi))
def test_the_response_of_a_q_filter_is_what_it_does(width, radians, phase):
    q = parts.Hann(width, 4096)
    wave = np.cos(radians * np.arange(-q.reach, q.chunk + q.reach) + phase)
    smoothed = np.empty(q.chunk)
    q.smooth(wave, smoothed)
    expected = q.response(np.array([radians]))[0] * wave[q.reach : q.reach + q.chunk]
    assert_allclose(smoothed, expected, atol=1e-10)


class Leaky(Weights):
    """Passes less than all of what does not change."""

    def __init__(self, width, cycle):
        super().__init__(np.ones(3), cycle)

    def response(self, radians):
        return 0.9 * super().response(radians)


class Late(Gaussian):
    """Does something else than it says."""

    def smooth(self, points, smoothed):
        super().smooth(points, smoothed)
        smoothed[:] = np.roll(smoothed, 1)


class Misled(Exponential):
    """Would be computed by the kernel of another one."""

    def smooth(self, points, smoothed):
        smoothed[:] = points[self.reach : -self.reach]


class Complex(Gaussian):
    """Has a phase."""

    def response(self, radians):
        return super().response(radians) * np.exp(1j * radians)


class Wide(QFilter):
    """Looks at more than there is, as some of ours do."""

    def __init__(self, width, cycle):
        super().__init__(cycle, cycle)

    def smooth(self, points, smoothed):
        raise NotImplementedError

    def response(self, radians):
        raise NotImplementedError


class Unmade(PlainMonitor):
    """Wants what nobody gives it."""

    def __init__(self, limit, step, colour):
        super().__init__(limit, step)

    def find(self, first, signal, other):
        raise NotImplementedError


class Constant(DeviationLaw):
    """Gives one number for all times."""

    def deviation(self, time):
        return np.zeros(1)


class Pole(DeviationLaw):
    """Is infinite somewhere."""

    def deviation(self, time):
        with np.errstate(divide="ignore"):
            return 1e-6 / (time - 0.5)


class Spiral(PartProfile):
    """Does not close."""

    def deviation(self, angle, height):
        return 1e-6 * angle


class Upside(PartProfile):
    """Has its heights in the wrong order."""

    heights = np.array([1.0, 0.0])

    def deviation(self, angle, height):
        return np.zeros_like(angle)


class Careless(PartProfile):
    """Goes wrong."""

    def deviation(self, angle, height):
        return angle[angle.size]


@pytest.mark.parametrize(
    ("parameter", "name", "says"),
    [
        ("q_filter", "nowhere:Hann", "Q filter 'nowhere:Hann' cannot be imported: ModuleNotFoundError: No module"),
        ("q_filter", "parts:Ham", "Q filter 'parts:Ham': parts has no 'Ham'"),
        ("q_filter", "parts:Chirp", "allowed: a class that derives from lathe_machine.control.q_filter.QFilter"),
        ("q_filter", "hann", "= 'hann'; allowed: one of fir, exponential, gaussian, moving_average, or PACKAGE.MODULE"),
        ("q_filter", "test_parts:Leaky", "learning_controller.q_filter: 'test_parts:Leaky': Q(0) = 0.9; allowed: 1"),
        ("q_filter", "test_parts:Late", "smooth differs from response by "),
        ("q_filter", "test_parts:Misled", "it derives from Exponential, which is computed elsewhere; allowed: derive"),
        ("q_filter", "test_parts:Complex", "response(radians) gives complex128 of shape (7,)"),
        ("q_filter", "test_parts:Wide", "Q filter reaches 1024 grid points to each side; allowed: less than half"),
        ("deviation_law", "test_parts:Constant", "gives float64 of shape (1,) for times of shape (60001,)"),
        ("deviation_law", "test_parts:Pole", "deviation(time) = inf at 0.5 s; allowed: finite numbers"),
        ("deviation_law", "parts:Chirp", "TypeError in speed_law.py, line "),
        ("profile", "test_parts:Spiral", "deviation jumps by 6.283e-06 m from 2π to 0 rad at height 0 m"),
        ("profile", "test_parts:Upside", "heights of shape (2,); allowed: one or more finite positions that increase"),
        ("profile", "test_parts:Careless", "tool.profile = 'test_parts:Careless': IndexError in test_parts.py, line "),
        ("monitors", "test_parts:Unmade", "monitor test_parts:Unmade: TypeError in "),
        ("monitors", "parts:Hann", "allowed: a class that derives from lathe_machine.safety.monitors.PlainMonitor"),
    ],
)
def test_what_is_no_such_part_is_refused_with_its_node_and_parameter(parameter, name, says):
    node = next(named.partition(".")[0] for named in NAMED if named.endswith(f".{parameter}"))
    values = {
        "q_filter": {"q_filter": name},
        "deviation_law": {"deviation_law": name, "deviation_values": []},
        "profile": {"profile": name, "profile_values": []},
        "monitors": {"monitors": [name, "parts:Drift"]},
    }
    told = refusal(node, **values[parameter])
    assert told.startswith(node)
    assert parameter in told
    assert says in told


@pytest.mark.parametrize(
    ("node", "values", "says"),
    [
        ("learning_controller", {"q_time": 0.0}, "learning_controller: learning diverges"),
        ("spindle_encoder", {"tachogram_time": [0.0], "tachogram_deviation": [0.1]},
         "spindle_encoder.deviation_law = parts:Chirp beside tachogram_time; allowed: one of them"),
        ("spindle_encoder", {"deviation_law_end": 0.1, "revolutions": 3.0},
         "spindle_encoder.deviation_law_end = 0.1 s: the run takes 0.16844 s at the speed there; allowed: not "),
        ("spindle_encoder", {"deviation_law_step": 1e-8},
         "spindle_encoder.deviation_law: 'parts:Chirp': 60 s in steps of 1e-08 s are 6000000001 points; allowed: "),
        ("tool", {"profile_values": [30.0, 1e-3, 0.01]}, "tool.profile: electrodynamic_actuator cannot follow it at "),
        ("supervisor", {"monitor_limits": [1.0]}, "supervisor.monitor_limits = [1.0]; allowed: one for each of parts:"),
        ("supervisor", {"monitor_signals": ["tool.error", "error"]}, "supervisor.monitor_signals: 'error'; allowed: "),
        ("supervisor", {"monitor_others": ["tool.errors", ""]}, "supervisor.monitor_others: 'tool.errors'; allowed: "),
        ("supervisor", {"monitor_reactions": ["warn", "stop"]}, "supervisor.monitor_reactions = stop, but no drive is"),
        ("supervisor", {"monitor_signals": ["fine/state.effort"] * 2}, "supervisor reads fine/state, which no node of"),
    ],
)  # fmt: skip
def test_what_a_cell_cannot_do_with_a_part_is_refused(node, values, says):
    assert refusal(node, **values).startswith(says)


# ---- speed laws


def test_who_looks_ahead_exactly_may_know_a_law_of_others():
    """exact_preview takes the same law; another one is refused."""
    knows = {"lead_law": "exact_preview", **PARTS["spindle_encoder"]}
    Cell(cell(learning_controller=knows).nodes).check()
    assert "it does not know the speed of spindle_encoder" in refusal(
        "learning_controller", **knows, deviation_law_end=50.0
    )


# ---- monitors


@given(cuts, st.integers(0, 2**32 - 1))
def test_a_monitor_finds_the_same_whatever_the_pieces(lengths, seed):
    signal = np.cumsum(np.random.default_rng(seed).standard_normal(sum(lengths)))
    whole = parts.Drift(0.05, 1e-3).find(0, signal, np.empty(0))
    monitor, found = parts.Drift(0.05, 1e-3), None
    for first, stop in spans(lengths):
        found = monitor.find(first, signal[first:stop], np.empty(0))
        if found is not None:
            found = Alarm(first + found.place, found.value)
            break
    assert found == whole


def test_a_monitor_of_others_asks_for_a_retraction_only_where_somebody_listens():
    asked = {"drives": ["coarse"], "clear_position": 1e-4, "monitor_reactions": ["warn", "retract"]}
    with pytest.raises(InputError, match="parts:Drift asks for retract, but no node that moves coarse reads safety"):
        Cell(cell(learning_controller={"reaction_delay": 0}, supervisor=asked).nodes).check()


class Impatient(PlainMonitor):
    """Goes wrong on the way."""

    def find(self, first, signal, other):
        if first < 1000:
            return None
        return Alarm(signal.size, 0.0) if self.limit else signal.colour


@pytest.mark.parametrize(
    ("limit", "says"),
    [
        (0.0, "supervisor: monitor test_parts:Impatient at sample 1024: AttributeError in test_parts.py, line "),
        (1.0, "supervisor: monitor test_parts:Impatient at sample 1024 finds something at place 1024 of 1024; allowed"),
    ],
)
def test_a_monitor_that_goes_wrong_ends_the_run_and_is_named(limit, says):
    values = {"monitors": ["test_parts:Impatient", "parts:Drift"], "monitor_limits": [limit, 1.0]}
    with pytest.raises(LatheError) as failed:
        harness.run(cell(supervisor=values))
    assert str(failed.value).startswith(says)


def test_a_monitor_begins_anew_at_a_reset():
    """It raises one alarm, and the next after a reset, with nothing kept of the samples before."""
    watched = {"events": ["sample 8000: reset"], "monitor_limits": [0.0, 1.0]}
    result = harness.run(cell(supervisor=watched))
    status = result.recording.sparse["/safety/status"].values
    assert (status["sample_index"], status["monitor"]) == ([0, 8000, 8000], ["parts:Drift", "reset", "parts:Drift"])
    error = result.recording.of_type(messages.TOOL)["measured_error"]
    assert status["value"][2] == parts.Drift(0.0, cell().shared.step).find(8000, error[8000:8001], np.empty(0)).value


# ---- installed packages, studies


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The parts of figures/parts.py as an installed distribution; what makes it one."""
    folder = tmp_path / "site"
    about = folder / "lathe_hann-0.3.dist-info"
    about.mkdir(parents=True)
    shutil.copy(FIGURES / "parts.py", folder / "lathe_hann.py")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lathe-hann\nVersion: 0.3\n")
    (about / "top_level.txt").write_text("lathe_hann\n")
    (about / "entry_points.txt").write_text(
        "[lathe_rc.q_filters]\nhann = lathe_hann:Hann\n"
        "[lathe_rc.studies]\npassed = lathe_hann:STUDY\nbroken = lathe_hann:NONE\n"
    )
    monkeypatch.syspath_prepend(folder)
    for found in (extensions._offered_along, extensions._packages):
        found.cache_clear()
    yield folder
    for found in (extensions._offered_along, extensions._packages):
        found.cache_clear()
    sys.modules.pop("lathe_hann", None)


def test_a_bag_says_where_a_stage_of_others_came_from():
    table = NodeParameters.read("filter", {"stage": "test_wiring:Repeater", "run_id": "test"})
    told = provenance.tell(Scenario("test", {**scenario().nodes, "filter": table}), [])
    (origin,) = provenance.origins(told)
    assert (origin.name, origin.used) == ("test_wiring:Repeater", ("filter.stage",))


def test_an_installed_part_has_a_name_and_its_bag_says_where_it_came_from(installed, tmp_path):
    harness.run(scenario(learning_controller={"q_filter": "hann"}), bag=tmp_path / "bag")
    with BagSource(tmp_path / "bag") as source:
        (origin,) = provenance.origins(source.about)
    assert (origin.name, origin.package) == ("lathe_hann:Hann", "lathe-hann 0.3")
    assert origin.used == ("learning_controller.q_filter",)
    assert origin.source == extensions.source_hash("lathe_hann")


def test_studies_of_others_are_listed_with_their_distribution(installed):
    """One that cannot be used says so in its line, and keeps no other away."""
    listed = {line.split()[0]: line for line in lathe("study").stdout.splitlines()}
    assert listed.keys() == {*STUDIES}
    assert listed["passed"].endswith("Which waves the Hann filter of figures/parts.py passes (lathe-hann 0.3)")
    assert listed["broken"].endswith("study 'broken' of lathe-hann 0.3: lathe_hann has no 'NONE'")
    assert listed["invariance"].endswith("(000, Figs 2-3)")
    assert "lathe-hann 0.3" in lathe("study", "--help").stdout


@pytest.mark.parametrize("words", [["passed"], ["--allow-code", "parts", "parts:STUDY"]])
def test_a_study_of_others_runs(installed, tmp_path, words):
    found = lathe("study", *words, "--set", "widths=2", "--figure", tmp_path / "a.png", "--json")
    assert found.exit_code == 0, found.stderr
    assert json.loads(found.stdout) == {
        "widths": [2.0],
        "waves": pytest.approx([62.0], rel=0.2),
        "figure": str(tmp_path / "a.png"),
    }


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("parts:Hann", "allowed: a lathe_rc.study.Study"),
        ("nowhere:STUDY", "cannot be imported: ModuleNotFoundError"),
    ],
)
def test_what_is_no_study_is_refused_in_one_line(name, says):
    refused = lathe("study", "--allow-code", "parts", "--allow-code", "nowhere", name)
    assert refused.exit_code == 2
    assert says in refused.stderr
    assert refused.stderr.count("\n") == 1


# ---- bags


def test_a_bag_without_parts_of_others_says_nothing_of_origins(tmp_path):
    harness.run(scenario(spindle_encoder={"revolutions": 1.0}), bag=tmp_path / "bag")
    with BagSource(tmp_path / "bag") as source:
        assert provenance.ORIGINS not in source.about


@pytest.mark.usefixtures("no_pictures")
def test_a_bag_shows_where_its_parts_came_from(recorded, tmp_path):
    path, _ = recorded
    assert lathe("report", path, "-o", tmp_path / "page.html").exit_code == 0
    info, page = lathe("bag", "info", path).stdout, (tmp_path / "page.html").read_text()
    source = extensions.source_hash("parts")
    for named, part in zip(NAMED, ("Chirp", "Hann", "Lobes", "Drift"), strict=True):
        assert f"{named}: parts:{part}, source {source}" in info
        assert f"parts:{part}" in page
    assert source in page


_ELSEWHERE = """
import contextlib, io, json, sys
from pathlib import Path
from lathe_rc.bag import reader
from lathe_rc.cli import main
from lathe_rc.view.report import write_report
bag, folder = Path(sys.argv[1]), Path(sys.argv[2])
codes = []
for words in (["bag", "info", bag], ["bag", "check", bag],
              ["export", bag, "--npz", "-o", folder / "out"], ["resim", bag]):
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            main([str(word) for word in words])
        except SystemExit as ended:
            codes.append(ended.code)
write_report(bag, folder / "page.html")
print(json.dumps([codes, reader.read_bag(bag).digests()]))
"""


@pytest.mark.system
def test_a_bag_is_read_where_its_parts_are_not_installed(recorded, tmp_path):
    """Where the parts are not, a bag is read, checked, exported and reported, and resim says what is missing.

    In a process of its own, which cannot import them.
    """
    path, result = recorded
    command = [sys.executable, "-c", _ELSEWHERE, path, tmp_path]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    codes, digests = json.loads(ended.stdout)
    assert (codes, digests) == ([0, 0, 0, 2], result.digest)
    assert ended.stderr == (
        "lathe: spindle_encoder.deviation_law: the bag was made with parts:Chirp, and there is no module parts; "
        "allowed: install parts, or --allow-code parts if it lies in the current folder\n"
    )


def told_by(path, origin):
    """The metadata of a bag, with another origin of its parts."""
    with BagSource(path) as source:
        about = dict(source.about)
    said = json.loads(about[provenance.ORIGINS])
    return {**about, provenance.ORIGINS: json.dumps({name: {**part, **origin} for name, part in said.items()})}


def test_what_is_not_here_is_to_be_installed(recorded):
    """If the parts came from a distribution, that is what the refusal names."""
    about = told_by(recorded[0], {"distribution": "lathe-hann", "version": "0.3"})
    about[provenance.ORIGINS] = about[provenance.ORIGINS].replace("parts:Hann", "lathe_hann:Hann")
    with pytest.raises(InputError, match=r"lathe_hann:Hann, and .*install lathe-hann 0\.3, or --allow-code lathe_hann"):
        provenance.scenario_of(about, Path())


@pytest.mark.parametrize(
    ("origin", "says"),
    [
        ({"source": "0" * 64}, "has source {here} here, and 000000000000 when the bag was made"),
        ({"distribution": "lathe-hann", "version": "0.3"}, "has version none here, and 0.3 when the bag was made"),
    ],
)
def test_a_re_simulation_with_other_parts_than_the_bag_s_warns(recorded, origin, says):
    path, _ = recorded
    assert provenance.changes(told_by(path, {}), cell()) == []
    expected = says.format(here=extensions.source_hash("parts")[:12])
    assert provenance.changes(told_by(path, origin), cell()) == [
        f"parts:{name} {expected}" for name in ("Chirp", "Hann", "Lobes", "Drift")
    ]


def test_the_command_warns_on_the_standard_error(recorded, monkeypatch):
    monkeypatch.setattr(provenance, "changes", lambda *_: ["parts:Hann has another source"])
    found = lathe("resim", recorded[0], "--json", "--allow-code", "parts")
    assert found.stderr == "lathe: warning: parts:Hann has another source\n"
    assert json.loads(found.stdout)["equal"]


@pytest.mark.parametrize("said", ["", "[]", '{"a": 1}', '{"a": {"used": 5}}', '{"a": {}}', "[" * 100_000])
def test_what_a_bag_says_of_origins_is_not_believed(said):
    """Broken texts about origins, in a bag of anybody, are none."""
    assert provenance.origins({provenance.ORIGINS: said}) == []
