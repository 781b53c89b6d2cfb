# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe reference``."""

import click

from lathe_rc import reference as pages


@click.command()
def reference() -> None:
    """Print the reference of nodes, topics, messages and parameters as Markdown."""
    click.echo(pages.page(), nl=False)
