# SPDX-License-Identifier: Apache-2.0
"""Draws img/cutting.png of cutting.md and prints its tables."""

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from lathe_machine.analysis.regeneration import Regeneration, lobes
from lathe_machine.plants.cutting import CuttingProcess
from lathe_machine.plants.cutting_force import PAPER, REALISTIC, RIGID, STEEL, Elasticity, SpecificForce
from lathe_machine.plants.workpiece import HardSpot, Workpiece
from lathe_machine.signals.allowance import PAPER_RMS, Allowance, mean_reverting
from lathe_machine.transfer import TransferFunction
from place import PICTURES

Array = npt.NDArray[np.float64]

STIFFNESS = 233.3e3  # W4 of paper 004 [N/m]
FEED = STEEL.feed_for(STIFFNESS)  # [m/rev]
DEPTH = 150.0 / STIFFNESS  # [m]
SPEED = 104.72  # 1000 rpm [rad/s]
OUTPUTS = ("force", "deflection", "depth_of_cut", "feed", "wear")
BLUE, RED, GREY = "#1f6f8b", "#c0392b", "#777777"


def cut(process: CuttingProcess, speed: float, step: float, feed: float, allowance: Array) -> dict[str, Array]:
    """Longitudinal turning at a constant speed [rad/s] and feed [m/rev]."""
    rate, still = np.full(allowance.size, speed), np.zeros(allowance.size)
    out = {name: np.empty(allowance.size) for name in OUTPUTS}
    process.block(
        angle=speed * step * np.arange(allowance.size), speed=rate, height=still, cross_position=still,
        displacement=still, feed_velocity=feed * rate / (2 * np.pi), allowance=allowance, **out,
    )  # fmt: skip
    return out


def chatter(
    elasticity: Elasticity, stiffness: float, period: float, step: float, duration: float, kick: float = 1e-7
) -> Array:
    """Deflection under regeneration [m], from the end of a slow rise of the blank on, where it kicks."""
    rise, samples = round(600.0 * np.sqrt(elasticity.inertia) / step), round(duration / step)
    part = np.minimum(np.arange(rise + samples) / rise, 1.0)
    blank = -1e-3 * (1.0 - part**3 * (10.0 - 15.0 * part + 6.0 * part**2))
    blank[rise : rise + 20] = kick
    process = CuttingProcess(
        material=SpecificForce(kc1=stiffness / 1e-3), depth=1e-3, lag=0.0, elasticity=elasticity, overlap=1.0, step=step
    )
    return cut(process, 2 * np.pi / period, step, 1e-3, blank)["deflection"][rise:]


print("| quantity | computed | spec |")
print("| --- | ---: | ---: |")
print(f"| feed at 233.3 N/mm | {FEED * 1e3:.4f} mm/rev | 0.071 |")
print(f"| depth at 150 N | {DEPTH * 1e3:.4f} mm | 0.643 |")
step = 0.02
allowance = np.empty(500_000)
walk = Allowance(
    mean_reverting(PAPER_RMS, 1.0, step), order=np.empty(0), amplitude=np.empty(0), phase=np.empty(0), seed=1
)
walk.block(np.zeros(allowance.size), allowance)
for lag, printed in ((0.0, "4.83"), (0.075, "")):
    force = cut(CuttingProcess(depth=DEPTH, lag=lag, step=step), SPEED, step, FEED, allowance)["force"][100:]
    relative = PAPER_RMS / allowance.std()  # the RMS of this walk is not exactly that of its law
    print(f"| force of 20.7 µm RMS, lag {lag * 1e3:g} ms | {force.std() * relative:.3f} N RMS | {printed} |")
for name, elasticity, printed in (("as printed", PAPER, "24"), ("realistic", REALISTIC, "469")):
    limit = Regeneration(elasticity.transfer, elasticity.away).worst()
    print(f"| limit of regeneration, W3 {name} | {limit.stiffness / 1e3:.2f} N/mm | about {printed} |")
other = Regeneration(PAPER.transfer, away=True).worst()
print(f"| the same as printed, but pushed away | {other.stiffness / 1e3:.2f} N/mm | |")

print("\n| W3 | chatter | µ = 1 | µ = 0.5 | µ = 0.2 | µ = 1, lag 75 ms |")
print("| --- | ---: | ---: | ---: | ---: | ---: |")
for name, elasticity in (("as printed", PAPER), ("realistic", REALISTIC)):
    lagging = elasticity.transfer * TransferFunction((1.0,), (0.075, 1.0))
    limits = [Regeneration(elasticity.transfer, elasticity.away, overlap).worst() for overlap in (1.0, 0.5, 0.2)]
    limits.append(Regeneration(lagging, elasticity.away).worst())
    texts = [f"{limit.stiffness / 1e3:.1f}" for limit in limits]
    print(f"| {name} | {limits[0].frequency / (2 * np.pi):.2f} Hz | {' | '.join(texts)} |")

print("\n| W3 | K [N/mm] | over the limit | growth by the root | growth simulated |")
print("| --- | ---: | ---: | ---: | ---: |")
figure = Figure(figsize=(13, 7.2), layout="constrained")
(random, interrupted), (chart, waves) = figure.subplots(2, 2)
for name, elasticity, step in (("as printed", PAPER, 1e-3), ("realistic", REALISTIC, 5e-5)):
    cutting = Regeneration(elasticity.transfer, elasticity.away)
    limit = cutting.worst()
    period = limit.period(1)
    for factor in (0.97, 1.03):
        stiffness = factor * limit.stiffness
        root = cutting.root(stiffness, period, 1j * limit.frequency)
        duration = 2.5 / abs(root.real)
        signal = chatter(elasticity, stiffness, period, step, duration)
        third = signal.size // 3
        ringing = signal - chatter(elasticity, stiffness, period, step, duration, kick=0.0)
        rate = np.log(np.std(ringing[2 * third :]) / np.std(ringing[third : 2 * third])) / (third * step)
        print(f"| {name} | {stiffness / 1e3:.2f} | {factor:.2f} | {root.real:+.5f} 1/s | {rate:+.5f} 1/s |")

step = 1e-3
time = step * np.arange(12_000)
blank = np.empty(time.size)
Allowance(
    mean_reverting(PAPER_RMS, 1.0, step), order=np.ones(1), amplitude=np.full(1, 10e-6), phase=np.zeros(1), seed=3
).block(12.0 * time, blank)
for lag, colour in ((0.0, GREY), (0.075, BLUE)):
    force = cut(CuttingProcess(depth=DEPTH, lag=lag, step=step), 12.0, step, FEED, blank)["force"]
    random.plot(time[2000:], force[2000:], color=colour, lw=1.0, label=f"lag {lag * 1e3:g} ms")
random.set(xlabel="time [s]", ylabel="force [N]")
random.set_title("allowance: walk of 20.7 µm RMS, run-out of 10 µm at 1.9 rev/s", fontsize=10)

step = 1 / 64000
turns = SPEED * step * np.arange(round(40 * np.pi / SPEED / step)) / (2 * np.pi)
part = Workpiece(gaps=[(2.0, 0.6), (2.0 + np.pi, 0.6)], hard_spots=[HardSpot(0.2, 1.0, -1.0, 1.0, 1.4)])
for lag, colour in ((0.0, GREY), (2e-3, BLUE), (0.075, RED)):
    process = CuttingProcess(depth=DEPTH, lag=lag, elasticity=RIGID, part=part, step=step)
    force = cut(process, SPEED, step, FEED, np.zeros(turns.size))["force"]
    last = turns > turns[-1] - 2
    interrupted.plot(turns[last], force[last], color=colour, lw=1.2, label=f"lag {lag * 1e3:g} ms")
interrupted.set(xlabel="revolution", ylabel="force [N]", ylim=(-5, 260))
interrupted.set_title("two keyways and a hard spot, 1000 rpm", fontsize=10)

cutting = Regeneration(REALISTIC.transfer)
frequencies = 2 * np.pi * np.concatenate((np.geomspace(53.06, 58.0, 400), np.geomspace(58.0, 400.0, 400)))
for number in range(6):
    speed, stiffness = lobes(cutting, number, frequencies)
    stiffness[stiffness > 3.35e6] = np.nan  # room for the legend
    chart.plot(speed * 30 / np.pi, stiffness / 1e3, color=BLUE, lw=1.2, label=None if number else "lobes")
limit = cutting.worst()
chart.axhline(
    limit.stiffness / 1e3, color=GREY, ls="--", lw=1.0, label=f"worst speed: {limit.stiffness / 1e3:.0f} N/mm"
)
step = 1e-4
for rpm in np.linspace(900.0, 4800.0, 14):
    for stiffness in np.linspace(300e3, 2300e3, 9):
        signal = chatter(REALISTIC, stiffness, 60.0 / rpm, step, 4.0)
        early, late = np.ptp(signal[: signal.size // 8]), np.ptp(signal[-signal.size // 8 :])
        grows = late > min(early, 1e-6)  # the worst of them has chattered before the kick already
        label = ("grows" if grows else "dies out") if rpm == 900.0 and stiffness in {300e3, 2300e3} else None
        # Crosses and circles also differ where red and blue do not.
        mark = {"marker": "x", "color": RED} if grows else {"marker": "o", "mfc": "none", "color": BLUE}
        chart.plot(rpm, stiffness / 1e3, ls="", ms=4, label=label, **mark)
chart.set(xlabel="spindle speed [rpm]", ylabel="K [N/mm]", ylim=(200, 3700), xlim=(800, 4900))
chart.set_title("regeneration, realistic W3: chart and simulated cuts", fontsize=10)

period, step = limit.period(1), 5e-5
for factor, colour in ((1.05, RED), (0.95, BLUE)):
    signal = chatter(REALISTIC, factor * limit.stiffness, period, step, 24.0)
    waves.plot(
        step * np.arange(signal.size),
        (signal - signal[0]) * 1e6,
        color=colour,
        lw=0.4,
        label=f"{factor:g} of the limit",
    )
waves.set(xlabel="time since a kick of 0.1 µm [s]", ylabel="change of the deflection [µm]")
waves.set_title("at the worst speed; loss of contact ends the growth", fontsize=10)
for axes in (random, interrupted, chart, waves):
    axes.grid(visible=True, alpha=0.25)
    legend = axes.legend(
        fontsize=8, loc="upper left" if axes in {random, waves} else "upper right", ncols=4 if axes is chart else 2
    )
    for line in legend.get_lines():
        line.set_linewidth(1.2)
figure.savefig(PICTURES / "cutting.png", dpi=130)
