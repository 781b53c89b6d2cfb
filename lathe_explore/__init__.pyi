# SPDX-License-Identifier: Apache-2.0
# The public face of lathe_explore, and the only list of it.

from lathe_explore.sweep.space import Space as Space
from lathe_explore.sweep.sweep import run_sweep as run_sweep
from lathe_explore.sweep.tune import tune as tune
