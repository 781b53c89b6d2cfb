# SPDX-License-Identifier: Apache-2.0
"""Tables and pictures as HTML: what a notebook shows when a result is the last line of a cell."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

from lathe_rc.analysis.form_errors import FormErrors


def errors_picture(errors: FormErrors, before: int) -> str:
    """The form error by revolution as a picture, if there is a revolution; ``before``: revolutions before the first."""
    if not errors.rms.size:
        return ""
    from lathe_rc.drawing import form

    image = base64.b64encode(form.learning(errors, before)._repr_png_()).decode()
    return f'<img alt="form error by revolution" src="data:image/png;base64,{image}" />'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; the first cell of a row names it."""
    style = 'style="text-align: left"'
    lines = ["".join(f"<th {style}>{escape(text)}</th>" for text in head)] if head else []
    for name, *cells in rows:
        lines.append(f"<th {style}>{escape(name)}</th>" + "".join(f"<td {style}>{escape(text)}</td>" for text in cells))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
