# SPDX-License-Identifier: Apache-2.0
"""Draws img/piezo.png of drives.md and prints its tables."""

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

import lathe_rc
from lathe_commission.hysteresis_fit import HysteresisLoop, identify
from lathe_machine.stages.drive.piezo_actuator import PiezoActuator, PiezoActuatorParameters
from lathe_machine.stages.drive.series_drive import SeriesDriveParameters, SeriesDriveStage
from lathe_rc import messages
from lathe_rc.cell import scenario
from lathe_rc.cell.parameters import SharedParameters
from place import CONFIG, PICTURES

STROKE, RATE = 15e-6, 64_000  # [m], [Hz]
TABLE = np.array([500.0, 1000.0, 1500.0, 2000.0])  # [rad/s], the columns of paper 001
KINDS = {"prandtl_ishlinskii": "#1f6f8b", "bouc_wen": "#c0392b"}

Array = npt.NDArray[np.float64]


def swing(frequency: float) -> Array:
    """Four sines over the whole stroke [m] at ``frequency`` [Hz]."""
    return STROKE * np.sin(2 * np.pi * frequency * np.arange(round(4 * RATE / frequency)) / RATE)


def position(set_point: Array, **values: Any) -> Array:
    """Displacement of a piezo drive as its sensor measures it, by default without noise [m]."""
    stage = PiezoActuator("piezo_actuator", PiezoActuatorParameters.read("piezo_actuator", values))
    state = messages.allocate(messages.STATE, set_point.size)
    stage.advance(0, [{"position": set_point}], [state])
    return np.asarray(state["measured_position"])


def error(**values: Any) -> Array:
    """A drive's residual of the last second of a swing at 1 Hz [m]."""
    return np.asarray((position(SLOW, **values) - SLOW)[-RATE:])


def percent(rest: Array) -> str:
    """RMS over the half-stroke."""
    return f"{100 * np.sqrt(np.mean(rest**2)) / STROKE:.3f} %"


def series(ratio: float, damping: float = 0.299) -> SeriesDriveStage:
    """Both drives as one."""
    values = {"mass_ratio": ratio, "fine_damping": damping}
    return SeriesDriveStage("series_drive", SeriesDriveParameters.read("series_drive", values))


def bend(frequency: float) -> float:
    """Extension over the carriage's amplitude, the piezo's set point being 0."""
    command = 1e-6 * np.sin(frequency * np.arange(RATE) / RATE)
    states = [messages.allocate(messages.STATE, RATE) for _ in range(2)]
    series(0.1).advance(0, [{"position": command}, {"position": np.zeros(RATE)}], states)
    carriage, extension = (state["position"][-RATE // 2 :] for state in states)
    return float(np.std(extension) / np.std(carriage))


SLOW = swing(1.0)
figure = Figure(figsize=(13, 4.0), layout="constrained")
loops, left, coupling = figure.subplots(1, 3)

print("| `hysteresis` | loop | exact | 5 % low | 15 % low | 15 % high |")
print("| --- | ---: | ---: | ---: | ---: | ---: |")
for kind, colour in KINDS.items():
    bare = position(SLOW, hysteresis=kind, linearisation="none")[-RATE:]
    width = (bare[RATE // 2] - bare[0]) / np.ptp(bare)  # at the zeros of the command, on its way down and up
    rests = {scale: error(hysteresis=kind, identified_scale=scale) for scale in (1.0, 0.95, 0.85, 1.15)}
    print(f"| `{kind}` | {100 * width:.1f} % | {' | '.join(percent(rest) for rest in rests.values())} |")
    dashes = "-" if kind == "prandtl_ishlinskii" else "--"
    loops.plot(SLOW[-RATE:] * 1e6, bare * 1e6, color=colour, ls=dashes, lw=1.3, label=kind)
    left.plot(np.arange(RATE) / RATE, rests[0.85] * 1e6, color=colour, lw=1.1, label=f"{kind}, 15 % low")
    left.plot(np.arange(RATE) / RATE, rests[1.0] * 1e6, color=colour, lw=1.1, ls=":", label=f"{kind}, exact")
loops.plot(SLOW[-RATE:] * 1e6, position(SLOW)[-RATE:] * 1e6, color="#777777", lw=0.9, label="linearised")

print("\n| loop at | noise | left by the fit | p0 | p1 … p10 | left when it linearises |")
print("| ---: | ---: | ---: | ---: | --- | ---: |")
for frequency, noise in ((1.0, 0.0), (1.0, 50e-9), (10.0, 0.0), (100.0, 0.0)):
    command = swing(frequency)
    found = identify(HysteresisLoop(command, position(command, linearisation="none", noise_rms=noise)), STROKE)
    weights, proportional = found.model.weights, found.model.proportional
    rest = error(identified_weights=weights.tolist(), identified_proportional=proportional)
    print(
        f"| {frequency:g} Hz | {noise * 1e9:g} nm | {100 * found.residual:.3f} % | {proportional:.4f} | "
        f"{weights.min():.4f} … {weights.max():.4f} | {percent(rest)} |"
    )

print("\n| $\\omega$ [rad/s] | " + " | ".join(f"{w:.0f}" for w in TABLE) + " |")
print("| --- | ---: | ---: | ---: | ---: |")
for damping in (0.299, 0.292):
    for ratio in (0.0, 0.1):
        cells = np.abs(1 - series(ratio, damping).drive.response(TABLE))
        name = rf"$\lvert 1 - W_{{pk}}\rvert$, $m/M = {ratio:g}$, $\zeta_2 = {damping:g}$"
        print(f"| {name} | {' | '.join(f'{c:.4f}' for c in cells)} |")
print(f"| bend of the piezo over $x_1$, $m/M = 0.1$ | {' | '.join(f'{bend(w):.4f}' for w in TABLE)} |")

parallel = lathe_rc.load(CONFIG / "direct_compensation.yaml", ["spindle_encoder.revolutions=60"])
shared = parallel.shared.model_dump(include=set(SharedParameters.model_fields))
direct = {"fine_use_command": False, "fine_use_reference": True, "fine_compensates": ["coarse"]}
print("\n| arrangement | RMS form error in revolution 60 |")
print("| --- | ---: |")
for ratio in (None, 0.0, 0.1):
    nodes, title = dict(parallel.nodes), "parallel (`config/direct_compensation.yaml`)"
    if ratio is not None:
        del nodes["electrodynamic_actuator"], nodes["piezo_actuator"]
        values = {**shared, **direct, "mass_ratio": ratio}
        nodes["series_drive"] = SeriesDriveParameters.read("series_drive", values)
        nodes["spindle_encoder"] = nodes["spindle_encoder"].model_copy(update={"members": list(nodes)})
        title = f"series, m/M = {ratio:g}"
    result = lathe_rc.run(scenario.Scenario("series", nodes))
    print(f"| {title} | {result.errors.rms[-1] * 1e9:.2f} nm |")

frequencies = np.geomspace(50.0, 20e3, 400)
for ratio, style in ((0.0, "-"), (0.03, "-."), (0.1, "--"), (0.3, ":")):
    rest = np.abs(1 - series(ratio).drive.response(frequencies))
    coupling.loglog(frequencies, rest, color="#1f6f8b", ls=style, lw=1.2, label=f"m/M = {ratio:g}")

loops.set(xlabel="command [µm]", ylabel="displacement [µm]")
loops.set_title("loops at 1 Hz", fontsize=10)
left.set(xlabel="time [s]", ylabel="error [µm]", ylim=(-0.8, 1.25))
left.set_title("what linearisation leaves", fontsize=10)
coupling.set(xlabel="frequency [rad/s]", ylabel="|1 − Wpk|")
coupling.set_title("what is left of a vibration", fontsize=10)
for axes in (loops, left, coupling):
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8, loc="upper left")
figure.savefig(PICTURES / "piezo.png", dpi=130)
