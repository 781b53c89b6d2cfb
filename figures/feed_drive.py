# SPDX-License-Identifier: Apache-2.0
"""Draws img/feed_drive.png of feed.md."""

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from lathe_machine.plants.feed import FeedDrive
from lathe_machine.plants.feed_models import dc_screw
from lathe_machine.plants.friction import Friction, mobility
from lathe_machine.plants.screw import Screw
from place import PICTURES

Array = npt.NDArray[np.float64]

GAIN, LAG, FORCE = 0.1, 0.045, 1000.0  # [m/s], [s], [N] at a command of 1
BLUE, RED, GREY = "#1f6f8b", "#c0392b", "#777777"
LUGRE = Friction("lugre", mobility(GAIN, LAG, FORCE), coulomb=10.0, static=15.0, speed=2e-3, stiffness=1e6, damping=1e4)


def drive(friction: Friction | None, step: float, screw: Screw | None = None) -> FeedDrive:
    """A slide."""
    return FeedDrive(dc_screw(GAIN, (LAG,)), step=step, friction=friction, screw=screw or Screw(), feedback="motor")


def driven(machine: FeedDrive, command: Array) -> tuple[Array, Array]:
    """Position and velocity under a command."""
    motion = np.zeros((5, command.size))
    machine.block(0, command, *motion)
    return motion[0], motion[1]


def followed(machine: FeedDrive, wanted: Array, gain: float) -> Array:
    """Position under a proportional position loop of ``gain`` [1/m]."""
    motion = np.zeros((5, wanted.size))
    seen = 0.0
    for n in range(wanted.size):
        machine.block(n, np.array([gain * (wanted[n] - seen)]), *motion[:, n : n + 1])
        seen = motion[4, n]
    return np.asarray(motion[0])


figure = Figure(figsize=(11, 8.2), layout="constrained")
steady, presliding = figure.add_subplot(221), figure.add_subplot(222)
circle, warm = figure.add_subplot(223, projection="polar"), figure.add_subplot(224)

speeds = np.linspace(-12e-3, 12e-3, 801)
steady.plot(speeds * 1e3, [LUGRE.steady(speed) for speed in speeds], color=GREY, lw=1.2, label="Stribeck curve")
for command in np.concatenate((np.linspace(-0.13, -0.012, 14), np.linspace(0.012, 0.13, 14))):
    # a push over Fs, so that slow motions begin too
    speed = driven(drive(LUGRE, 1e-4), np.concatenate((np.full(2000, np.sign(command)), np.full(30_000, command))))[1][
        -1
    ]
    steady.plot(speed * 1e3, FORCE * (command - speed / GAIN), "o", ms=4, color=BLUE)
steady.set(xlabel="speed [mm/s]", ylabel="friction [N]", title="at steady speeds")
steady.plot([], [], "o", ms=4, color=BLUE, label="LuGre, simulated")

step = 1e-3
time = step * np.arange(20_000)
for level, colour in ((15.6, RED), (12.0, BLUE), (6.0, GREY)):
    command = level / FORCE * np.sin(2 * np.pi * 0.1 * time)
    position, velocity = driven(drive(LUGRE, step), command)
    acceleration = np.gradient(velocity, step)
    force = FORCE * (command - velocity / GAIN - LAG / GAIN * acceleration)
    presliding.plot(position[200:] * 1e6, force[200:], color=colour, lw=1.0, label=f"driven by {level:g} N")
presliding.set(xlabel="way [µm]", ylabel="friction [N]", title="to and fro, Fs = 15 N")

time = step * np.arange(40_000)
angle = 2 * np.pi * 0.05 * time
for friction, colour, label in ((None, GREY, "no friction"), (LUGRE, RED, "LuGre")):
    x, y = (followed(drive(friction, step), 20e-3 * wave, 120.0) for wave in (np.sin(angle), 1.0 - np.cos(angle)))
    last = slice(20_000, None)
    # x = r·sin φ, y = r·(1 - cos φ): the centre is at (0, r)
    radius = np.hypot(x, y - 20e-3)[last]
    error = radius - np.median(radius)
    place = np.arctan2(y[last] - 20e-3, x[last])
    circle.plot(place, 20.0 + 20.0 * error * 1e3, color=colour, lw=1.2, label=label)
    print(f"{label}: radius error {np.ptp(error) * 1e6:.1f} µm from peak to valley")
print(f"2·Fc/(F1·Kp) = {2 * 10.0 / FORCE / 120.0 * 1e6:.1f} µm")
circle.set_rlim(0.0, 26.0)
circle.set_rticks([10.0, 20.0])
circle.set_title("a circle of 20 mm at 6.3 mm/s, error × 20")

step = 0.01
time = step * np.arange(round(7200.0 / step))
command = 0.8 * np.cos(2 * np.pi * time / 7.5)
screw = Screw(slope=10e-6, amplitude=2e-6, lead=10e-3, heating=60.0, time=1500.0)
motion = np.zeros((5, time.size))
drive(None, step, screw).block(0, command, *motion)
error, place = (motion[0] - motion[3]) * 1e6, motion[3] * 1e3
for minute, colour in ((0.0, GREY), (20.0, BLUE), (119.0, RED)):
    at = slice(round(minute * 60.0 / step), round((minute * 60.0 + 7.5) / step))
    warm.plot(place[at], error[at], color=colour, lw=1.0, label=f"minute {minute:.0f}")
warm.set(xlabel="place [mm]", ylabel="error of the slide [µm]", title="pitch error and growth of the screw")
for axes in (steady, presliding, warm):
    axes.grid(visible=True, alpha=0.25)
    axes.legend(fontsize=8)
circle.legend(fontsize=8, loc="lower left", bbox_to_anchor=(-0.2, -0.05))
figure.savefig(PICTURES / "feed_drive.png", dpi=110)
