# SPDX-License-Identifier: Apache-2.0
"""Options shared by sweep and tuning; this module imports only Click."""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeVar, cast

import click

from lathe_explore.sweep import LOOP_FIGURES
from lathe_rc.commands import options

F = TypeVar("F", bound=Callable[..., Any])

tie = options.of_targets("--tie", metavar="NODE.PARAM=FORMULA", help="such as fine_controller.q_time*1.1")


class Sampling(NamedTuple):
    """Sample of ranges and distributions, as the options of `sampling` give it.

    Attributes:
        sample: sampler and number of points.
        seed: random seed.
        correlated: texts ``TARGET,TARGET=NUMBER``.
    """

    sample: str
    seed: int
    correlated: tuple[str, ...]


def sampling(command: F) -> F:
    """Add the options of a sample to a command, which gets them as ``sampling``."""

    @wraps(command)
    def with_sampling(sample: str, sample_seed: int, correlate: tuple[str, ...], **more: Any) -> Any:
        return command(sampling=Sampling(sample, sample_seed, correlate), **more)

    own = [
        click.option(
            "--sample",
            default="",
            metavar="SAMPLER:N",
            help="points of ranges LOW:HIGH and of laws: sobol, halton, latin, random, saltelli",
        ),
        click.option("--sample-seed", type=click.IntRange(0), default=0, show_default=True, help="of the sample"),
        click.option(
            "--correlate", multiple=True, metavar="TARGET,TARGET=NUMBER", help="correlation of two drawn parameters"
        ),
    ]
    found: Any = with_sampling
    for option in reversed(own):
        found = option(found)
    return cast("F", found)


seeds = click.option(
    "--seeds", type=click.IntRange(1), default=1, show_default=True, help="each cell with so many seeds"
)

measures = click.option(
    "--measure",
    "measures",
    multiple=True,
    metavar="TOPIC.FIELD:STATISTIC",
    help="more columns: max, rms, mean, peak_to_valley; or NODE.FIGURE of a force or position controller: "
    + ", ".join(LOOP_FIGURES),
)


def many_cells(folder: str) -> Callable[[F], F]:
    """Return the last options of a command that computes many cells; ``folder``: default of ``--out``, in words."""
    own = [
        click.option("--out", type=options.PATH, help=f"folder of the results; default: {folder}"),
        click.option("--scheduler", metavar="ADDRESS", help="of Dask; default: workers on this machine"),
        click.option("--workers", type=click.IntRange(1), help="processes on this machine; default: one for each core"),
        click.option(
            "--cell-time",
            type=click.FloatRange(0.0, min_open=True),
            metavar="SECONDS",
            help="time limit of a cell; default: 20 times the slowest so far, at least 60 s",
        ),
    ]

    def added(command: F) -> F:
        for option in reversed(
            [options.overrides, options.length, options.start_from, *own, options.allow_code, options.as_json]
        ):
            command = option(command)
        return command

    return added
