# SPDX-License-Identifier: Apache-2.0
"""Templates of the files of a C library or an FMU."""

from jinja2 import Environment, PackageLoader, StrictUndefined

TEMPLATES = Environment(
    loader=PackageLoader("lathe_export", "templates"),
    undefined=StrictUndefined,
    keep_trailing_newline=True,
    autoescape=False,  # noqa: S701 - C and Markdown, not HTML
)
