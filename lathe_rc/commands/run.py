# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe run``: a scenario to its end."""

import json
from pathlib import Path

import click
from rich.console import Console

from lathe_rc import harness, part
from lathe_rc.bag.record import recorder_of
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stages.spindle_encoder import SpindleEncoder
from lathe_rc.commands import outcome
from lathe_rc.commands import scenario as options
from lathe_rc.commands.progress import Watch
from lathe_rc.errors import InputError

_NO_SNAPSHOTS = "no snapshots: no --bag was given"


def run_shown(
    scenario: Scenario,
    *,
    mode: harness.Mode,
    groups: list[list[str]] | None,
    bag: Path | None,
    domain: int | None = None,
    namespace: str = "/",
) -> harness.Result:
    """Run a scenario and show its progress; the arguments are those of `lathe_rc.harness.run`."""
    with Watch(Console(stderr=True)) as watch:
        return harness.run(scenario, mode=mode, groups=groups, bag=bag, watch=watch, domain=domain, namespace=namespace)


@click.command()
@click.argument("scenario")
@click.option("--mode", type=click.Choice(["offline", "composed", "processes"]), default="offline", show_default=True)
@options.groups
@click.option("--revolutions", type=click.FloatRange(min=0, min_open=True), help="length of the run")
@click.option("--speed-factor", type=click.FloatRange(min=0), help="pace against real time; 0: as fast as possible")
@click.option("--bag", type=click.Path(path_type=Path), help="folder to record to; must not exist")
@click.option("--profile", type=click.Path(path_type=Path), help="CSV file to write the last revolution's profile to")
@options.overrides
@click.option("--domain", type=click.IntRange(0, 232), help="ROS domain, for others to listen; default: a free one")
@click.option("--namespace", help="of the nodes, for two cells in one domain; default: /")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def run(
    scenario: str,
    mode: harness.Mode,
    groups: tuple[str, ...],
    revolutions: float | None,
    speed_factor: float | None,
    bag: Path | None,
    profile: Path | None,
    overrides: tuple[str, ...],
    domain: int | None,
    namespace: str | None,
    *,
    as_json: bool,
) -> None:
    """Run a SCENARIO, a ROS 2 parameter file, to its end."""
    loaded = options.load(scenario, overrides)
    asked = {"revolutions": revolutions, "speed_factor": speed_factor}
    given = {name: value for name, value in asked.items() if value is not None}
    changes = [f"{node}.{n}={v!r}" for node in loaded.of_kind(SpindleEncoder.kind) for n, v in given.items()]
    if changes:
        loaded = options.load(scenario, [*overrides, *changes])
    split = options.split(loaded, groups)
    if groups and mode != "processes":
        raise InputError(f"--group with --mode {mode}; allowed: --mode processes")
    for option, value in (("--domain", domain), ("--namespace", namespace)):
        if value is not None and mode == "offline":
            raise InputError(f"{option} {value} with --mode offline; allowed: --mode processes or composed")
    result = run_shown(loaded, mode=mode, groups=split, bag=bag, domain=domain, namespace=namespace or "/")
    if profile:
        part.write_profile(profile, result.recording, result.part, [result.errors.rms.size - 1])
    if as_json:
        click.echo(json.dumps(result.summary()))
        return
    asks_for_snapshots = recorder_of(loaded)[1].mode != "continuous"
    told = _NO_SNAPSHOTS if asks_for_snapshots and not bag else ""
    outcome.show(result, {"profile": profile} if profile else {}, told=told)
