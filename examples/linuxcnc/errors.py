# SPDX-License-Identifier: Apache-2.0
"""Print the form error of some revolutions from the samples of lathe.hal: errors.py SAMPLES."""

import sys

import numpy as np

angle, command, error = np.loadtxt(sys.argv[1], unpack=True)  # [rad] [m] [m]
revolution = np.floor_divide(angle, 2.0 * np.pi)
command_of = [np.abs(command[revolution == number]).max() for number in range(int(revolution.max()))]
began = next(number for number, largest in enumerate(command_of) if largest > 0.0)
for number in range(began, len(command_of), 5):
    rms = np.sqrt(np.mean(error[revolution == number] ** 2))
    print(f"revolution {number}: error {1e6 * rms:.3g} µm RMS, command up to {1e6 * command_of[number]:.3g} µm")
