# SPDX-License-Identifier: Apache-2.0
"""Tables that take long to make, kept on the disk beside the compiled code.

To load SciPy's interpolation takes a sixth of the time in which `lathe run` reaches its first block, and it is only
needed to make the table of a form, the same one each time.
"""

import hashlib
import io
from collections.abc import Callable
from contextlib import suppress

import llvmlite.binding
import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.files import replacing, sealed
from lathe_rc.jit import cache_folder, read_kept

Array = npt.NDArray[np.float64]

_MOST = 32  # tables, the newest


def kept(content: bytes, make: Callable[[], Array]) -> Array:
    """The array that ``make`` makes of some content: read, if the same libraries have made it on such a processor.

    A file that is damaged is said and made anew, and one that cannot be written is not kept.
    """
    made_by = f"{np.__version__} {scipy.__version__} {llvmlite.binding.get_host_cpu_name()}".encode()
    path = cache_folder() / "tables" / f"{hashlib.sha256(made_by + content).hexdigest()}.npy"
    if (found := read_kept(path)) is not None:
        read: Array = np.load(io.BytesIO(found))
        return read
    table = make()
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(written := io.BytesIO(), table)
        with replacing(path) as file:
            file.write(sealed(written.getvalue()))
        for old in sorted(path.parent.glob("*.npy"), key=lambda file: file.stat().st_mtime)[:-_MOST]:
            old.unlink(missing_ok=True)
    return table
