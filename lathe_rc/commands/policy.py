# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe policy``: SROS2 permissions of the nodes of a scenario."""

from pathlib import Path

import click

from lathe_rc import security
from lathe_rc.commands import options
from lathe_rc.commands import scenario as scenarios
from lathe_rc.errors import InputError
from lathe_rc.files import replacing


@click.command()
@options.scenario
@options.groups
@click.option("--namespace", default="/", show_default=True, help="of the cell")
@click.option("--with", "beside", multiple=True, type=click.Choice(security.BESIDE), help="let in as well; repeatable")
@options.overrides
@options.allow_code
@click.option("-o", "--output", type=options.PATH, help="file to write; default: the standard output")
def policy(
    scenario: str,
    groups: tuple[str, ...],
    namespace: str,
    beside: tuple[str, ...],
    overrides: tuple[str, ...],
    output: Path | None,
) -> None:
    """Generate the SROS2 policy of a SCENARIO: one enclave per process, with the least permissions its nodes need."""
    loaded = scenarios.load(scenario, overrides)
    split = scenarios.split(loaded, groups)
    made = security.policy(loaded, groups=split, namespace=namespace, beside=beside)
    text = security.to_xml(made, f"the scenario {loaded.name}")
    if output is None:
        click.echo(text, nl=False)
        return
    try:
        with replacing(output) as file:
            file.write(text.encode())
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror})") from None
    click.echo(f"{output}: enclaves {' '.join(made)}")
