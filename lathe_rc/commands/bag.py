# SPDX-License-Identifier: Apache-2.0
"""Command group ``lathe bag``: content, verification and recovery of a bag, and its tachogram."""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import click
from rich.console import RenderableType

from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.check import check as check_bag
from lathe_rc.bag.reading import stream
from lathe_rc.bag.reading.limits import SIMULATED
from lathe_rc.bag.reading.source import BagSource, files_of, name_of
from lathe_rc.bag.repairing.recover import Choice
from lathe_rc.bag.repairing.recover import copy as copy_chosen
from lathe_rc.bag.repairing.recover import recover as recover_bag
from lathe_rc.commands import lossy, measured, options, tables
from lathe_rc.commands.tachogram import make as make_tachogram
from lathe_rc.errors import InputError, LatheError, LossyRunError, shown
from lathe_rc.judge import part
from lathe_rc.names import instead

_BAG = click.argument("path", metavar="BAG", type=options.PATH)
_LOSSY = LossyRunError.exit_code  # exit code if messages are missing


@click.group()
def bag() -> None:
    """Inspect, verify and recover bags, and extract the tachogram."""


def _metrics(path: Path, types: Mapping[str, str]) -> dict[str, Any]:
    """Return the numbers of the part's first and last revolution, and why they are not those of the whole run.

    Both are None without a part. Memory use is bounded.
    """
    if not {messages.TOOL, messages.ENCODER} <= set(types.values()):
        return {}
    ends = part.FirstAndLast(types)
    header = stream.feed(path, [ends])
    return {"error_um": ends.numbers(), "not_measured": ends.soundness.why or (str(header.loss or "") or None)}


@bag.command()
@_BAG
@click.option("--metrics/--no-metrics", default=True, help="form error of the part; reads the whole bag")
@click.option(
    "--scenario/--no-scenario",
    "whole",
    default=None,
    help="the whole scenario; default: only if the output is not a terminal, whose top it would scroll away",
)
@options.as_json
@click.pass_context
def info(ctx: click.Context, path: Path, *, metrics: bool, whole: bool | None, as_json: bool) -> None:
    """Show topics, rates, time span, date, events, scenario and the form error of the part.

    For a damaged bag, or one that lacks samples, show the readable content and what is wrong; exit code 3.
    """
    with BagSource(path, partial=True) as source:
        summary = _info(path, source, metrics=metrics)
        tables.show(summary, _told(source, summary, whole=whole), as_json=as_json)
        ctx.exit(_LOSSY if source.damage or summary["lost"] else 0)


def _info(path: Path, source: BagSource, *, metrics: bool) -> dict[str, Any]:
    """Return what is shown of a bag; what cannot be read is added to the damage of its source."""
    span = (source.last_ns - source.first_ns) * 1e-9
    types = {topic: entry.type for topic, entry in source.topics.items()}
    topics: dict[str, dict[str, Any]] = {
        topic: {
            "type": entry.type,
            "messages": entry.count,
            "rate_hz": (entry.count - 1) / span if span > 0 and entry.count > 1 else None,
        }
        for topic, entry in sorted(source.topics.items())
    }
    summary: dict[str, Any] = {
        "bag": str(path),
        "start_s": source.first_ns * 1e-9,
        "start": _date(source.first_ns),
        "span_s": span,
        "written": _date(max((file.stat().st_mtime_ns for file in files_of(path)), default=0)),
        "topics": topics,
        "unread": [asdict(each) for each in source.unread],
        "about": dict(source.about),
        "seal": source.seal.digest if source.seal else None,
        "contradictions": source.contradictions,
        "foreign": provenance.foreign(source.about),
        "damage": source.damage,
        "lost": None,
        "events": [],
        "first_sample": 0,
        "error_um": None,
        "not_measured": None,
    }
    try:
        for _, _, data in source.messages({topic for topic, kind in types.items() if kind == messages.EVENT}):
            event = messages.decode(messages.EVENT, data)
            summary["events"].append({"sample": event.sample_index, "node": event.source, "action": event.action})
        summary["lost"] = str(source.loss) if source.loss else None
        summary["first_sample"] = stream.first_of(source)
        summary |= _metrics(path, types) if metrics and not source.damage else {}
    except (LatheError, ValueError) as error:
        source.damage.append(str(error))
    return summary


def _told(source: BagSource, summary: Mapping[str, Any], *, whole: bool | None) -> Iterator[RenderableType]:
    yield tables.of_rows(
        summary["topics"].items(),
        {
            "topic": lambda row: row[0],
            "type": lambda row: row[1]["type"].rpartition("/")[2],
            "messages": lambda row: str(row[1]["messages"]),
            "rate [Hz]": lambda row: f"{row[1]['rate_hz']:.4g}" if row[1]["rate_hz"] else "",
        },
        left=2,
        no_wrap=True,
    )
    yield from (f"not read: {each}" for each in source.unread)
    for what in (*summary["contradictions"], *summary["damage"], *filter(None, [summary["lost"]])):
        click.echo(what, err=True)
    yield from summary["foreign"]
    start = summary["start"] or format(summary["start_s"], ".6g") + " s"
    yield f"span: {summary['span_s']:.6g} s from {start} on"
    yield f"written: {summary['written']}"
    if source.seal:
        yield f"seal: {source.seal}"
    if summary["first_sample"]:
        yield f"recorded from sample {summary['first_sample']} of the run on"
    if summary["error_um"]:
        first, last = summary["error_um"]["first"], summary["error_um"]["last"]
        yield (
            f"form error: {first['rms']:.4g} µm RMS in revolution {first['revolution']}, "
            f"{last['rms']:.4g} in {last['revolution']}"
        )
        if summary["not_measured"] and not summary["lost"]:
            yield f"form error {summary['not_measured']}"
    for event in summary["events"]:
        yield f"event: sample {event['sample']}, {event['node']}: {event['action']}"
    yield from _about_told(summary["about"], whole=not sys.stdout.isatty() if whole is None else whole)


def _about_told(about: Mapping[str, str], *, whole: bool) -> Iterator[str]:
    """Yield the metadata strings of a bag; of the scenario the ``whole`` or its length."""
    for key, text in about.items():
        if key == provenance.SCENARIO and not whole:
            yield f"scenario: {text.strip().count(chr(10)) + 1} lines; --scenario prints them"
        elif key == provenance.SCENARIO:
            yield "scenario:\n  " + text.strip().replace("\n", "\n  ")
        elif key == provenance.ORIGINS:
            for origin in provenance.origins({key: text}):
                of = f" of {origin.package}" if origin.package else ""
                yield f"{', '.join(origin.used)}: {origin.name}{of}, source {origin.source}"
        elif key.startswith(provenance.FILE):
            yield f"{key.removeprefix(provenance.FILE)}: a file, {len(text)} characters in base64"
        else:
            yield f"{key.removeprefix('lathe_rc.')}: {text}"


def _date(log_ns: int) -> str | None:
    """Return the date of a log time in UTC; None for simulated time, which begins near 0."""
    if log_ns < SIMULATED:
        return None
    return datetime.fromtimestamp(log_ns // 10**9, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")


@bag.command()
@_BAG
@options.as_json
@click.pass_context
def check(ctx: click.Context, path: Path, *, as_json: bool) -> None:
    """Verify sequence, gaps, numbers, checksums and recorded digests.

    Exit code 0: clean, 3: lossy, 1: wrong, 2: not a bag, or unreadable. Code and files that the bag names but does not
    contain are listed, one per line.
    """
    found = check_bag(path)
    summary = {
        "bag": str(path),
        "clean": not found.exit_code,
        "wrong": found.wrong,
        "lost": found.lost,
        "foreign": found.foreign,
        "unread": found.unread,
        "origin": found.origin,
        "messages": found.messages,
        "samples": found.samples,
        "digests_compared": found.compared,
        "digest": found.digests,
    }
    unread = (f"not read: {each}" for each in found.unread)
    state = {0: "clean", 1: "wrong", _LOSSY: "lossy"}[found.exit_code]
    digests = f"{found.compared} digests as recorded" if found.compared else "no digests recorded"
    told = f"{state}: {found.messages} messages, {found.samples} samples, {digests}"
    tables.show(summary, [*found.origin, *found.wrong, *found.lost, *found.foreign, *unread, told], as_json=as_json)
    ctx.exit(found.exit_code)


@bag.command()
@_BAG
@click.option("-o", "--output", type=options.PATH, help="folder of the new bag; default: BAG_recovered")
@options.as_json
@click.pass_context
def recover(ctx: click.Context, path: Path, output: Path | None, *, as_json: bool) -> None:
    """Copy the intact content of a damaged bag to a new one; exit code 0: no message is missing, 3: some are."""
    target = output or path.with_name(f"{path.stem if path.is_file() else path.name}_recovered")
    found = recover_bag(path, target)
    summary = {
        "bag": str(path),
        "output": str(target),
        "saved": found.saved,
        "skipped": found.skipped,
        "missing": found.missing,
        "lost_bytes": found.lost_bytes,
        "damage": list(found.damage),
    }
    told = f"{found.saved} messages saved, {found.skipped} skipped, {found.lost_bytes} B lost"
    tables.show(summary, [*found.damage, told, f"bag: {target}"], as_json=as_json)
    ctx.exit(_LOSSY if found.lossy else 0)


@bag.command("copy")
@click.argument("paths", metavar="BAG...", type=options.PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=options.PATH, required=True, help="folder of the new bag")
@options.topics("all")
@click.option("--without", multiple=True, metavar="TOPIC", help="left out; repeatable")
@click.option("--start", type=click.FloatRange(0), default=0.0, help="[s] from the first message on")
@click.option("--end", type=click.FloatRange(0), help="[s] from the first message on; default: to the end")
@options.as_json
@click.pass_context
def copy_bags(
    ctx: click.Context,
    paths: tuple[Path, ...],
    output: Path,
    topics: tuple[str, ...],
    without: tuple[str, ...],
    start: float,
    end: float | None,
    *,
    as_json: bool,
) -> None:
    """Copy chosen messages of bags to a new one, byte for byte: filter, cut, merge, or convert from SQLite to MCAP.

    Several bags are merged in the order of their log times; a single one keeps its order. Exit code 3: a bag is
    damaged, and its damaged parts are left out.
    """
    first, known = list[int](), set[str]()
    for path in paths:
        with BagSource(path, partial=True) as source:
            first += [source.first_ns] if any(topic.count for topic in source.topics.values()) else []
            known |= source.topics.keys() | {each.topic for each in source.unread}
    for topic in (*topics, *without):
        if topic not in known:
            raise InputError(
                f"no topic {shown(topic)!r} in {', '.join(map(str, paths))}; {instead(topic, sorted(known))}"
            )
    if end is not None and end <= start:
        raise InputError(f"--end {end:g} with --start {start:g}; allowed: an end after the start")
    begin_ns = min(first, default=0)
    from_ns = begin_ns + round(start * 1e9)
    to_ns = 2**64 if end is None else begin_ns + round(end * 1e9)
    found = copy_chosen(paths, output, Choice(frozenset(topics), frozenset(without), from_ns, to_ns))
    damage = [f"{each.path}: {what}" for each in found for what in each.damage]
    saved = [f"{each.saved} messages of {each.path}" for each in found]
    bags = [{"bag": str(each.path), "saved": each.saved, "damage": list(each.damage)} for each in found]
    tables.show({"output": str(output), "bags": bags}, [*damage, *saved, f"bag: {output}"], as_json=as_json)
    ctx.exit(_LOSSY if any(each.lossy for each in found) else 0)


@bag.command()
@_BAG
@click.option("-o", "--output", type=options.PATH, help="CSV file; default: BAG-tachogram.csv, here")
@click.option(
    "--tolerance",
    type=options.POSITIVE,
    default=0.1,
    show_default=True,
    help="greatest distance of the file's lines from a recorded speed [rpm]",
)
@click.option("--topic", default="", help="of the encoder; default: the only one")
@measured.columns
@options.as_json
def tachogram(
    path: Path, output: Path | None, tolerance: float, topic: str, columns: tuple[str, ...], *, as_json: bool
) -> None:
    """Write the recorded spindle speed as a CSV file for tachogram_file, with as few rows as the tolerance allows."""
    target = output or Path(f"{name_of(path).removesuffix('.mcap')}-tachogram.csv")
    made = make_tachogram(path, target, tolerance, topic, columns)
    held = f"{made.points} rows for {made.samples} samples of {made.field}"
    text = [f"{held}, within {made.largest:.4g} rpm: {target}"]
    if made.stands_from is not None:
        stands = f"the spindle stands still for {made.standstill:.4g} s, first at {made.stands_from:.4g} s"
        text += [f"{stands}: a spindle_encoder refuses the rows with 0 rpm"]
    tables.show({"bag": str(path), "output": str(target), **asdict(made)}, text, as_json=as_json)
    lossy.end(path)
