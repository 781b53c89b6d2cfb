# SPDX-License-Identifier: Apache-2.0
"""Where the scripts of this folder put their pictures: docs/img, or the folder that LATHE_PICTURES names."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config"
PICTURES = Path(os.environ.get("LATHE_PICTURES", ROOT / "docs" / "img"))
