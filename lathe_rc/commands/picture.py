# SPDX-License-Identifier: Apache-2.0
"""Image file of an option ``--figure``."""

from pathlib import Path
from typing import TYPE_CHECKING

from lathe_rc import files
from lathe_rc.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def check_place(path: Path) -> None:
    """Check, before any computation, that an image file can be written.

    Raises:
        InputError: no image can be written to the path.
    """
    if path.suffix.lower() != ".png":
        raise InputError(f"--figure {path}; allowed: a file name that ends in .png")
    files.check_place("--figure", path)


def save(figure: "Figure", path: Path) -> None:
    """Write a figure to a file.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise InputError(f"--figure {path}: cannot be written ({error.strerror})") from None
