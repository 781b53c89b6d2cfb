# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe budget``: contributions of the causes to the form error of a scenario."""

import click

from lathe_rc.commands import options


@click.command()
@options.scenario
@click.option("--revolutions", type=options.POSITIVE, help="length of the runs")
@options.overrides
@options.allow_code
@options.as_json
def budget(scenario: str, revolutions: float | None, overrides: tuple[str, ...], *, as_json: bool) -> None:
    """Show what each cause contributes to the form error of a SCENARIO, from offline runs with causes switched off."""
    from lathe_rc.commands import outcome, tables
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.commands.progress import watched_budget

    loaded = scenarios.load(scenario, overrides, revolutions=revolutions)
    found = watched_budget(loaded)
    tables.show({"scenario": loaded.name, **found.summary()}, outcome.budget_told(found), as_json=as_json)
