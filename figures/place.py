# SPDX-License-Identifier: Apache-2.0
"""Place of the pictures (docs/img, or the folder that LATHE_PICTURES names), and the frame of the drawings."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config"
PICTURES = Path(os.environ.get("LATHE_PICTURES", ROOT / "docs" / "img"))

_TIP = (
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
    'orient="auto-start-reverse"><path d="M 0 0 L 8 4 L 0 8 z" fill="#7f8c92"/></marker></defs>'
)


def drawing(script: str, width: float, height: float, style: str, drawn: list[str]) -> str:
    """Return an SVG of drawn parts, whose arrows end in ``url(#tip)``."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
            f"<!-- SPDX-License-Identifier: Apache-2.0; drawn by figures/{script} -->",
            f"<style>{style}</style>",
            _TIP,
            *drawn,
            "</svg>\n",
        ]
    )
