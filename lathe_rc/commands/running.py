# SPDX-License-Identifier: Apache-2.0
"""Execution of ``lathe run`` after its arguments are parsed and its modules imported."""

from pathlib import Path
from typing import Any

from rich.console import Console

from lathe_rc import harness
from lathe_rc.cell.scenario import Scenario
from lathe_rc.commands import outcome, picture, tables
from lathe_rc.commands import scenario as scenarios
from lathe_rc.commands.progress import RunProgress, watched_budget
from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import check_place
from lathe_rc.judge import part
from lathe_rc.process_launcher import Start

_NO_SNAPSHOTS = "no snapshots: no --bag was given"


def watched(scenario: Scenario, **how: Any) -> harness.Result:
    """Run a scenario with a progress display; the keywords are those of `lathe_rc.harness.run`."""
    with RunProgress(Console(stderr=True)) as watch:
        return harness.run(scenario, watch=watch, **how)


def run(
    scenario: str,
    *,
    mode: harness.Mode,
    groups: tuple[str, ...],
    revolutions: float | None,
    speed_factor: float | None,
    strict: bool,
    bag: Path | None,
    checkpoints: tuple[tuple[str, Path], ...],
    start_from: Path | None,
    profile: Path | None,
    figure: Path | None,
    overrides: tuple[str, ...],
    domain: int | None,
    namespace: str | None,
    start: Start | None,
    require_tolerance: bool,
    budget: bool,
    as_json: bool,
) -> None:
    """Run a scenario; the arguments are the options of `lathe_rc.commands.run`.

    Raises:
        InputError: options contradict each other, or the scenario cannot run.
        LatheError: the run failed, or exceeds the required tolerance.
    """
    given = {"revolutions": revolutions, "speed_factor": speed_factor}
    loaded = scenarios.load(scenario, overrides, strict=strict, start_from=start_from, **given)
    split = scenarios.split(loaded, groups)
    if groups and mode != "processes":
        raise InputError(f"--group with --mode {mode}; allowed: --mode processes")
    for option, value in (("--domain", domain), ("--namespace", namespace), ("--start", start)):
        if value is not None and mode == "offline":
            raise InputError(f"{option} {value} with --mode offline; allowed: --mode processes or composed")
    if strict and mode == "offline":
        raise InputError("--strict with --mode offline, which has no pace; allowed: --mode processes or composed")
    if require_tolerance:
        _check_tolerance(loaded)
    if figure:
        picture.check_place(figure)
    written = [("--profile", profile)] if profile else []
    for option, path in written + [("--checkpoint", path) for _, path in checkpoints]:
        check_place(option, path)
    result = watched(
        loaded,
        mode=mode,
        groups=split,
        bag=bag,
        domain=domain,
        namespace=namespace or "/",
        start=start or "fork",
        checkpoints=dict(checkpoints),
    )
    if profile:
        part.write_profile(profile, result.recording, result.part, [result.errors.rms.size - 1])
    if figure:
        picture.save(result.plot(), figure)
    found = watched_budget(loaded) if budget else None
    asks_for_snapshots = loaded.recorder[1].mode != "continuous"
    note = _NO_SNAPSHOTS if asks_for_snapshots and not bag else ""
    files = [(name, path) for name, path in (("profile", profile), ("figure", figure)) if path]
    files += [(f"checkpoint at {when}", path) for when, path in checkpoints]
    tables.show(
        lambda: result.summary() | ({"budget": found.summary()} if found else {}),
        outcome.told(result, dict(files), note=note, budget=found),
        as_json=as_json,
    )
    if require_tolerance:
        alike = " with the same --set" if overrides else ""
        _require_tolerance(result, "" if found else f"; lathe budget {scenario}{alike} tells why")


def _require_tolerance(result: harness.Result, hint: str) -> None:
    """Check that a run ended within each tolerance.

    Raises:
        LatheError: it did not; ``hint`` ends the message for the part.
    """
    name = result.scenario.name
    judged = [(name, result.verdict, hint)]
    judged += [(f"{node} of {name}", loop.verdict, "") for node, loop in result.loops.items()]
    for what, verdict, more in judged:
        if verdict and not verdict.in_tolerance:
            raise LatheError(f"{what} is {verdict.told()}; allowed: no more than the tolerance{more}")


def _check_tolerance(scenario: Scenario) -> None:
    """Check that a node of a scenario has a tolerance.

    Raises:
        InputError: none has one.
    """
    judged = {name: table for name, table in scenario.nodes.items() if "tolerance" in table.judging}
    if any(getattr(table, "tolerance") for table in judged.values()):  # noqa: B009 - of a tool or a servo
        return
    name = next(iter(judged), "tool")
    cure = f" ({scenario.name} has no tool and no force or position loop)"
    if judged:
        value = "5.0" if judged[name].rows()["tolerance"].unit == "N" else "2e-6"
        cure = f", or --set {name}.tolerance={value}"
    raise InputError(f"--require-tolerance without {name}.tolerance; allowed: a scenario that has one{cure}")
