# SPDX-License-Identifier: Apache-2.0
"""Options that several commands have; to import them takes no more than click."""

from collections.abc import Iterable

import click

from lathe_rc import trust

allow_code = click.option(
    trust.OPTION,
    multiple=True,
    metavar="PACKAGE",
    is_eager=True,
    expose_value=False,
    callback=lambda _ctx, _option, packages: _allow(packages),
    help="import classes that scenario, bag or members name from this package, also of the current folder; repeatable",
)


def _allow(packages: Iterable[str]) -> None:
    for package in packages:
        trust.allow(package)


overrides = click.option(
    "--set", "overrides", multiple=True, metavar="NODE.PARAM=VALUE", help="also PARAM=VALUE if shared"
)

groups = click.option(
    "--group",
    "groups",
    multiple=True,
    metavar="NODE+NODE",
    help="nodes that share a process, instead of those that the scenario names; repeatable; none: one each",
)

start = click.option(
    "--start",
    type=click.Choice(["fork", "spawn"]),
    help="processes are forked from one that has imported everything, or interpreters of their own; default: fork",
)

length = click.option("--revolutions", type=click.FloatRange(min=0, min_open=True), help="length of each run")

scheduler = click.option("--scheduler", metavar="ADDRESS", help="of Dask; default: workers on this machine")

workers = click.option(
    "--workers", type=click.IntRange(1), help="processes on this machine; default: one for each core"
)
