# SPDX-License-Identifier: Apache-2.0
"""Draws img/piezo.png of piezo.md and prints its tables."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from lathe_rc.analysis.hysteresis_fit import Loop, identify
from lathe_rc.cell import messages
from lathe_rc.cell.stages.piezo_actuator import PiezoActuator, PiezoActuatorParameters
from lathe_rc.cell.stages.series_drive import SeriesDriveParameters, SeriesDriveStage

HERE = Path(__file__).parent
STROKE, RATE = 15e-6, 64_000  # [m], [Hz]
TABLE = np.array([500.0, 1000.0, 1500.0, 2000.0])  # [rad/s], the columns of paper 001
KINDS = {"prandtl_ishlinskii": "#1f6f8b", "bouc_wen": "#c0392b"}

Array = npt.NDArray[np.float64]


def swing(frequency: float, amplitude: float = 1.0, periods: int = 4) -> Array:
    """A sine of so many half-strokes [m] at ``frequency`` [Hz]."""
    samples = round(periods * RATE / frequency)
    return amplitude * STROKE * np.sin(2 * np.pi * frequency * np.arange(samples) / RATE)


def position(set_point: Array, **values: str | float) -> Array:
    """Displacement of a piezo drive [m]."""
    stage = PiezoActuator("piezo_actuator", PiezoActuatorParameters.read("piezo_actuator", values))
    state = messages.allocate(messages.STATE, set_point.size)
    stage.advance(0, [{"position": set_point}], [state])
    return np.asarray(state["position"])


def series(ratio: float, damping: float = 0.299) -> SeriesDriveStage:
    """Both drives as one."""
    values = {"mass_ratio": ratio, "fine_damping": damping}
    return SeriesDriveStage("series_drive", SeriesDriveParameters.read("series_drive", values))


def row(values: Array, digits: int = 4) -> str:
    """Cells of a table."""
    return " | ".join(f"{value:.{digits}f}" for value in values)


period = RATE  # of a swing at 1 Hz, in samples
slow = swing(1.0)
figure = Figure(figsize=(13, 4.0), layout="constrained")
loops, left, coupling = figure.subplots(1, 3)

print("| hysteresis | loop | left, exact model | 5 % low | 15 % low | 15 % high |")
print("| --- | ---: | ---: | ---: | ---: | ---: |")
for kind, colour in KINDS.items():
    bare = position(slow, hysteresis=kind, linearisation="none")[-period:]
    # At the zeros of the command, on the way up and on the way down.
    width = (bare[period // 2] - bare[0]) / np.ptp(bare)
    cells = []
    for scale in (1.0, 0.95, 0.85, 1.15):
        error = (position(slow, hysteresis=kind, identified_scale=scale) - slow)[-period:]
        cells.append(np.sqrt(np.mean(error**2)) / STROKE)
        if scale in (1.0, 0.85):
            style = {"color": colour, "ls": "-" if scale < 1.0 else ":"}
            left.plot(np.arange(period) / period, error * 1e6, label=f"{kind}, factor {scale:g}", **style)
    print(f"| `{kind}` | {100 * width:.1f} % | " + " | ".join(f"{100 * cell:.3f} %" for cell in cells) + " |")
    loops.plot(slow[-period:] * 1e6, bare * 1e6, color=colour, lw=1.0, label=kind)
loops.plot(slow[-period:] * 1e6, position(slow)[-period:] * 1e6, color="#444444", lw=0.8, label="linearised")

print("\n| loop recorded at | noise | left by the fit | p0 | p1 … p10 | left when it linearises |")
print("| ---: | ---: | ---: | ---: | --- | ---: |")
for frequency, noise in ((1.0, 0.0), (1.0, 50e-9), (20.0, 0.0), (100.0, 0.0)):
    command = swing(frequency)
    loop = Loop(
        command,
        position(command, linearisation="none") + noise * np.random.default_rng(0).standard_normal(command.size),
    )
    found = identify(loop, STROKE)
    weights = found.model.weights
    model = PiezoActuatorParameters(play_weights=weights.tolist(), play_proportional=found.model.proportional)
    # The drive keeps its own hysteresis, so the found inverse goes into the set point.
    inverse = np.empty_like(slow)
    model_stack = model.stack("identified").table.inverse
    from lathe_rc.plants.hysteresis import PrandtlIshlinskiiInverse

    PrandtlIshlinskiiInverse(found.model).block(slow / STROKE, inverse)
    error = (position(inverse * STROKE, linearisation="none") - slow)[-period:]
    print(
        f"| {frequency:g} Hz | {noise * 1e9:g} nm | {100 * found.residual:.3f} % | {found.model.proportional:.4f} | "
        f"{weights.min():.4f} … {weights.max():.4f} | {100 * np.sqrt(np.mean(error**2)) / STROKE:.3f} % |"
    )
