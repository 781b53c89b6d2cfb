# SPDX-License-Identifier: Apache-2.0
"""Random drives are measured, fitted and designed for: no law that `lathe design` offers diverges on the true drive."""

import json

import numpy as np
import pytest
from bags import some
from cells import scenario
from click.testing import CliRunner

import lathe_rc
from lathe_commission import design
from lathe_commission.commands import design as command
from lathe_machine.plants.modes import carriage
from lathe_rc.analysis.frequency_response import of_states
from lathe_rc.analysis.tolerance import growth
from lathe_rc.cli import main
from lathe_rc.errors import LatheError
from lathe_rc.signals.measurement_file import read

pytestmark = pytest.mark.system
DRIVE = "electrodynamic_actuator"
TURN = 2.0 * np.pi
LONG = 150.0  # revolutions of a run with the true drive
THINNED = 6  # of the filters of each law that has many
FINEST = 2000


def random_drive(rng):
    """Second order with a delay and modes, a third of the drives with lags, complex residues, and any gain."""
    modes = int(rng.integers(0, 4))
    values = {
        "natural_frequency": TURN * rng.uniform(120.0, 220.0),
        "damping": rng.uniform(0.4, 1.2),
        "delay": rng.uniform(0.1e-3, 0.4e-3),
    }
    if modes:
        frequency = np.sort(rng.uniform(400.0, 2200.0, modes))
        values["mode_frequency"] = (TURN * frequency).tolist()
        values["mode_damping"] = rng.uniform(0.006, 0.03, modes).tolist()
        values["mode_participation"] = (rng.choice([-1.0, 1.0], modes) * rng.uniform(0.003, 0.02, modes)).tolist()
    kind = rng.integers(3)
    if kind == 1:
        values["gain"] = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0))
    if kind == 2:
        values["lag_time"] = [1.0 / (TURN * rng.uniform(250.0, 800.0))]
        values["lag_participation"] = [rng.uniform(-0.4, 0.4)]
        if modes:
            values["mode_velocity"] = rng.uniform(-0.005, 0.005, modes).tolist()
    return values


def cell(**drive):
    return scenario(
        {"block_size": 64, "nominal_rpm": 3000.0},
        spindle_encoder={"revolutions": 40.0, "counts_per_revolution": 4096},
        learning_controller={"feedback_delay": 600, "allow_unstable": True},
        electrodynamic_actuator={"noise_rms": 50e-9, "max_acceleration": 1000.0, **drive},
        tool={"profile": "harmonics", "harmonic_order": [2], "harmonic_amplitude": [220e-6], "tolerance": 1e-6},
    )


def measure(path, values, rng):
    """Write the response of a drive at 40 to 2000 points, with noise of 60 dB."""
    table = cell(**values).nodes[DRIVE]
    equations = carriage(table.natural_frequency, table.damping, table.modes(DRIVE))
    points = int(np.exp(rng.uniform(np.log(40.0), np.log(FINEST))))
    spaced = np.geomspace if rng.random() < 0.5 else np.linspace
    hertz = spaced(5.0, 3000.0, points)
    p = 1j * TURN * hertz
    whole = p[:, None, None] * np.eye(equations.command.size) - equations.a
    response = np.linalg.solve(whole, np.broadcast_to(equations.command[:, None], (points, equations.command.size, 1)))
    value = table.gain * np.exp(-p * table.delay) * response[:, 0, 0]
    value *= 1.0 + 1e-3 * (rng.normal(size=points) + 1j * rng.normal(size=points))
    rows = np.stack((hertz, value.real, value.imag, np.full(points, 1e-3)), axis=1)
    np.savetxt(path, rows, delimiter=",", header="frequency_hz,real,imaginary,relative_uncertainty", comments="")
    return points


def diverges(made, values):
    """Return whether a designed cell diverges with the true drive, and how."""
    given = {f"{DRIVE}.{name}": value for name, value in values.items()}
    run = {"learning_controller.allow_unstable": True, "spindle_encoder.revolutions": LONG}
    # What the fit has and the true drive has not.
    bare = {f"{DRIVE}.{name}": [] for name in ("mode_frequency", "mode_damping", "mode_participation")}
    bare |= {f"{DRIVE}.{name}": [] for name in ("mode_velocity", "lag_time", "lag_participation")}
    try:
        errors = lathe_rc.run(made.with_models_given().varied({**bare, f"{DRIVE}.gain": 1.0, **given, **run})).errors
    except LatheError as error:
        return str(error)
    grown = growth(errors.largest)
    return grown.told() if grown and grown.diverges else ""


def one(number, folder):
    """Return what became of a drive: the refusal of its fit, or the laws offered and how they diverge."""
    rng = np.random.default_rng(number)
    values = random_drive(rng)
    file, fitted = folder / f"{number}.csv", folder / f"{number}.yaml"
    found = {"number": number, "values": values, "points": measure(file, values, rng)}
    words = ["fit", "drive", str(file), "--drives", "4", "-o", str(fitted), "--figure", str(folder / "figure.png")]
    done = CliRunner().invoke(main, words)
    found["fit"] = "" if done.exit_code == 0 else done.output.strip().splitlines()[-1]
    if done.exit_code:
        return found
    loaded = cell()
    responses = [each for path in command._points(fitted) for each in of_states(read(path, {}))]
    other, _ = command._other_speed(loaded, None, None)
    made = design.Design(loaded, command._drives(fitted), 0.3, responses, other).candidates()
    found["laws"] = {
        each.law: each.reason or diverges(each.scenario, values) or f"runs, margin {each.margin.error:.3g}"
        for each in made
    }
    found["diverged"] = [
        each.law for each in made if not each.reason and not found["laws"][each.law].startswith("runs")
    ]
    return found


@pytest.fixture
def thinned(monkeypatch):
    few = {
        name: design.FilteredLaw(law.kind, law.fixed, law.filters[:: max(1, len(law.filters) // THINNED)], law.lead)
        for name, law in design.LAWS.items()
    }
    monkeypatch.setattr(design, "LAWS", few)


@pytest.mark.usefixtures("thinned")
@pytest.mark.parametrize("number", some(list(range(200)), 100))
def test_campaign_no_law_that_is_offered_diverges_on_the_true_drive(number, tmp_path):
    """Drives of the class of `lathe fit drive`, measured with 40 to 2000 points; what is not offered has a reason."""
    found = one(number, tmp_path)
    assert not found.get("diverged"), json.dumps(found, indent=1)
