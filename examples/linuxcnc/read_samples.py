# SPDX-License-Identifier: Apache-2.0
"""Write the samples of sampler.0 into a file, one line each; halsampler would print six decimals.

python3 read_samples.py FILE SAMPLES CFG, in a HAL file after "start"; a line "overrun" stands for lost samples.
"""

import sys
import time
from pathlib import Path

import hal

FIFO = 0x48534130  # SAMPLER_SHMEM_KEY of LinuxCNC: the first FIFO of sampler

component = hal.component("read_samples")
component.ready()
samples = hal.stream(component, FIFO, sys.argv[3])
with Path(sys.argv[1]).open("w", encoding="utf-8") as file:
    for number in range(int(sys.argv[2])):
        while not samples.readable:
            time.sleep(0.01)
        row = samples.read()
        if samples.sampleno != number + 1:
            print("overrun", file=file)
        print(*row, file=file)
