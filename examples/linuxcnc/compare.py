# SPDX-License-Identifier: Apache-2.0
"""Compare the samples of cell.hal with a bag of the same cell in the engine, bit by bit: compare.py SAMPLES BAG."""

import sys

import numpy as np

import lathe_rc

SIGNALS = ("/encoder.angle", "/coarse/command.position", "/coarse/state.position",
           "/coarse/state.measured_position", "/tool.measured_error")  # fmt: skip

columns = np.loadtxt(sys.argv[1], unpack=True)
topics = lathe_rc.read_bag(sys.argv[2]).dense
different = False
for signal, column in zip(SIGNALS, columns, strict=True):
    topic, _, field = signal.partition(".")
    engine = topics[topic][field]
    if engine.size < column.size:
        sys.exit(f"{sys.argv[2]}: {engine.size} samples; allowed: at least {column.size}")
    wrong = np.flatnonzero(column.view(np.uint64) != engine[: column.size].view(np.uint64))
    print(f"{signal}: {column.size} samples, " + (f"different from sample {wrong[0]} on" if wrong.size else "equal"))
    different = different or wrong.size > 0
sys.exit(different)
