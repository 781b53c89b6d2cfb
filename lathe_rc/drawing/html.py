# SPDX-License-Identifier: Apache-2.0
"""Tables and images as HTML, for results in a notebook."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

from lathe_rc.signals.form_errors import FormErrors


def errors_picture(errors: FormErrors, before: int) -> str:
    """Return an image of the form error by revolution, if any; ``before`` revolutions precede the first one."""
    if not errors.rms.size:
        return ""
    from lathe_rc.drawing import form

    image = base64.b64encode(form.learning(errors, before)._repr_png_()).decode()
    return f'<img alt="form error by revolution" src="data:image/png;base64,{image}" />'


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table; the first cell of each row is its header."""
    style = 'style="text-align: left"'
    lines = ["".join(f"<th {style}>{escape(text)}</th>" for text in head)] if head else []
    for name, *cells in rows:
        lines.append(f"<th {style}>{escape(name)}</th>" + "".join(f"<td {style}>{escape(text)}</td>" for text in cells))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
