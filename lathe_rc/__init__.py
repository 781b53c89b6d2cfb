# SPDX-License-Identifier: Apache-2.0
"""Control cell of a CNC lathe for non-circular turning, emulated offline or as ROS 2 nodes.

    import lathe_rc

    piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=20"])
    result = lathe_rc.run(piston, bag="piston_bag")
    print(result.errors.rms[-1], result.digest)

The public names are listed in ``__init__.pyi``; the docstring of each contains an example.
"""

import importlib
import os
from typing import Any

from lathe_rc import numba_settings

__version__ = "0.1.0"

numba_settings.ignore_current_folder()

# The matrices are small, and waiting BLAS threads would occupy cores that other nodes need.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def __getattr__(name: str) -> Any:
    public = importlib.import_module("lathe_rc.public")  # on demand, so that importing lathe_rc is fast
    return public.attribute(__name__, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__getattr__("__all__")])
