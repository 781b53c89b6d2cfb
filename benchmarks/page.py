# SPDX-License-Identifier: Apache-2.0
"""docs/performance.md, made from a stored result; ``./lathe bench --page COMMIT`` writes it.

What the parts tell of themselves comes from their docstrings, what a reader should know beyond figures from
performance_notes.md beside this file.
"""

import ast
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parent
_NOTES = _HERE / "performance_notes.md"
GROWTH_IMAGE = "img/growth.png"  #: of the page, in docs/

_TITLES = {
    "engine": "Offline engine",
    "batch": "Batches",
    "sweep": "Sweeps",
    "ros": "Over ROS",
    "real_time": "Real time",
    "supervisor": "Supervisor",
    "start": "Cold start",
    "recorder": "Recorder",
    "viewer": "Viewer",
    "resimulation": "Re-simulation",
    "growth": "Growth",
    "peers": "Drive and loop",
}
_TARGET = "target_"
_MOST_COLUMNS = 7  # of a table; what has more is laid on its side
_UNITS = (
    ("_messages_per_s", "messages/s"),
    ("_samples_per_s", "samples/s"),
    ("_mb_per_s", "MB/s"),
    ("_per_s", "1/s"),
    ("_us_per_block", "µs/block"),
    ("_us_per_message", "µs/message"),
    ("_ns_per_sample", "ns/sample"),
    ("_ns", "ns"),
    ("_us", "µs"),
    ("_um", "µm"),
    ("_ms", "ms"),
    ("_mb", "MB"),
    ("_percent", "%"),
    ("_s", "s"),
)
_WORDS = {
    "lathe_rc": "`lathe_rc`",
    "lathe_rc_blocks": "`lathe_rc` in blocks of 64",
    "scipy_lfilter": "scipy `lfilter`",
    "scipy_dlsim": "scipy `dlsim`",
    "scipy_lsim": "scipy `lsim`, continuous drive",
    "control_forced_response": "python-control `forced_response`",
    "control_input_output_response": "python-control `input_output_response`",
    "drake": "Drake diagram",
    "mcap": "`mcap`",
    "rosbags": "`rosbags`",
    "rosbags_arrays": "`rosbags`, objects",
    "rr_log": "`rr.log` a sample",
}


# ---- figures ------------------------------------------------------------------------------------------------------


def _is_spread(value: object) -> bool:
    return isinstance(value, Mapping) and "median" in value


def _is_figure(value: object) -> bool:
    return not isinstance(value, Mapping | list) or _is_spread(value)


def _number(value: float) -> str:
    """Four digits; no exponents where a reader would count zeros."""
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if value and not 1e-3 <= abs(value) < 1e7:
        return f"{value:.2e}"
    if abs(value) >= 1e4:
        return f"{value:,.0f}".replace(",", "\u202f")
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def figure(value: Any) -> str:
    """A figure as it stands in a table: a median with its range, a number, a word."""
    if _is_spread(value):
        middle, low, high = (_number(float(value[key])) for key in ("median", "low", "high"))
        return middle if low == high else f"{middle} ({low} … {high})"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return _number(value) if isinstance(value, int | float) else str(value)


def _named(key: str) -> str:
    """A key as words, with its unit in brackets."""
    if key in _WORDS:
        return _WORDS[key]
    if key.isdecimal():
        return _number(int(key))
    bare, unit = next(((key[: -len(end)], unit) for end, unit in _UNITS if f"_{key}".endswith(end)), (key, ""))
    words = bare.replace("_", " ").replace("lathe rc", "`lathe_rc`").strip()
    return f"{words} [{unit}]" if words and unit else words or unit


def _goal(group: Mapping[str, Any], key: str) -> str:
    """The target of a figure in a group, and whether it is met."""
    target, found = group.get(f"{_TARGET}{key}"), group.get(key)
    value = found["median"] if isinstance(found, Mapping) and _is_spread(found) else found
    if target is None or not isinstance(value, int | float):
        return ""
    return f"≥ {target:g}: {'met' if value >= target else '**not met**'}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], texts: Sequence[int] = (0,)) -> list[str]:
    """Lines of a table; columns without a word in them are left out.

    Args:
        head: names of the columns.
        rows: cells.
        texts: columns that are not numbers.
    """
    kept = [list(row) for row in rows]
    used = [k for k in range(len(head)) if k == 0 or any(row[k] for row in kept)]
    lines = [[head[k] for k in used], ["---" if k in texts else "---:" for k in used]]
    lines += [[row[k] for k in used] for row in kept]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


# ---- any part -----------------------------------------------------------------------------------------------------


def _is_flat(value: object) -> bool:
    """Whether there is nothing but figures in it."""
    return isinstance(value, Mapping) and not _is_spread(value) and all(map(_is_figure, value.values()))


def _part(name: str, found: Mapping[str, Any], level: int = 3) -> list[str]:
    """Everything in a part: its figures, its groups with figures alike as one table, a section for any other."""
    single = [key for key, value in found.items() if _is_figure(value) and key != "took_s" and _TARGET not in key]
    flat = {key: value for key, value in found.items() if _is_flat(value)}
    names = Counter(column for group in flat.values() for column in group)
    flat = {key: group for key, group in flat.items() if any(names[column] > 1 for column in group)}
    lines: list[str] = []
    if single:
        rows = [(_named(key), figure(found[key]), _goal(found, key)) for key in single]
        lines += _table(("figure", "found", "target"), rows)
    if flat:
        lines += _together(name, flat)
    for key, group in found.items():
        if isinstance(group, Mapping) and not _is_figure(group) and key not in flat:
            lines += [f"{'#' * min(level, 6)} {_named(key)}", "", *_part(f"{name}.{key}", group, level + 1)]
    return lines


def _together(name: str, groups: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One table of groups that have figures of the same names."""
    columns = [key for key in dict.fromkeys(key for group in groups.values() for key in group) if _TARGET not in key]
    cells = {
        key: [figure(group[column]) if column in group else "" for column in columns] for key, group in groups.items()
    }
    goals = {
        key: "; ".join(goal for column in columns if (goal := _goal(group, column))) for key, group in groups.items()
    }
    if len(columns) <= _MOST_COLUMNS:
        rows = [[_named(key), *row, goals[key]] for key, row in cells.items()]
        return _table(["", *map(_named, columns), "target"], rows)
    sides = [[_named(column), *(row[k] for row in cells.values())] for k, column in enumerate(columns)]
    if any(goals.values()):
        sides.append(["target", *goals.values()])
    return _table(["", *map(_named, groups)], sides)


def _about(name: str) -> list[str]:
    """What a part's docstring says, without its first line."""
    path = _HERE / f"{name}.py"
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) if path.exists() else None
    return [*(text or "").replace("``", "`").splitlines(), ""]


# ---- parts that are known -----------------------------------------------------------------------------------------


def _peer_rows(result: Mapping[str, Any]) -> Iterable[Sequence[str]]:
    """Job, peer, figure of lathe_rc, figure of the peer, how many times as fast lathe_rc is, what to know."""
    peers, nothing = result.get("peers", {}), "not measured"
    drive, loop = peers.get("drive", {}), peers.get("loop", {})
    for name, found in drive.items():
        if name == "lathe_rc_blocks" or (isinstance(found, Mapping) and name != "lathe_rc"):
            same = found["same_difference_equation"]
            note = f"{'same' if same else 'another'} model, {figure(found['largest_difference_um'])} µm apart at most"
            figures = [figure(side["ns_per_sample"]) for side in (drive["lathe_rc"], found)]
            yield "drive, ns/sample", _WORDS.get(name, name), *figures, figure(found["ratio"]), note
    if loop:
        ours, theirs = loop["lathe_rc_samples_per_s"], loop["drake_samples_per_s"]
        errors = [figure(loop.get(f"{side}_last_rms_um", nothing)) for side in ("lathe_rc", "drake")]
        note = loop.get("reason") or f"error in the last revolution {errors[0]} and {errors[1]} µm RMS"
        shown = [figure(ours), figure(theirs) if theirs else nothing]
        yield "loop, samples/s", _WORDS["drake"], *shown, figure(loop.get("ratio", "")), note
    jobs = {
        "write_none": "writing, no compression",
        "write_zstd": "writing, zstd",
        "read_zstd": "reading, zstd",
    }
    for job, words in jobs.items():
        sides = result.get("recorder", {}).get(job, {})
        for name, found in sides.items():
            if "ratio" in found:
                ours = sides["lathe_rc_arrays" if name.endswith("_arrays") else "lathe_rc"]
                node = f"recorder node: {figure(found['node_ratio'])}" if "node_ratio" in found else ""
                figures = [figure(side["messages_per_s"]) for side in (ours, found)]
                yield f"{words}, messages/s", _WORDS.get(name, name), *figures, figure(found["ratio"]), node
    viewer = result.get("viewer", {})
    if "rr_log" in viewer:
        for side, note in (("lathe_view", "thinned"), ("lathe_view_every_sample", "every sample")):
            rates = [figure(viewer[name]["samples_per_s"]) for name in (side, "rr_log")]
            yield "export, samples/s", _WORDS["rr_log"], *rates, figure(viewer[side]["ratio"]), note
    elif "reason" in viewer:
        yield "export, samples/s", _WORDS["rr_log"], nothing, nothing, "", viewer["reason"]


def _slope(value: Any) -> str:
    """A slope; of times the median of the rounds."""
    return f"{round(value['median'] if _is_spread(value) else value, 2) + 0.0:+.2f}"


def _growth(found: Mapping[str, Any]) -> list[str]:
    """The picture, the slopes, and the points in a table each."""
    slopes = {
        what: {key: _slope(value) for key, value in group.items() if key.endswith("_slope")}
        for what, group in found.items()
        if isinstance(group, Mapping)
    }
    lines = [f"![Time per block and memory over what is varied]({GROWTH_IMAGE})", ""]
    lines += _together("growth.slopes", slopes)
    for what, group in found.items():
        if isinstance(group, Mapping) and "points" in group:
            lines += [f"### {_named(what)}", "", *_together(f"growth.{what}", group["points"])]
    return lines


def _ros(found: Mapping[str, Any]) -> list[str]:
    """A table of each cell: block sizes and arrangements below each other; then what else there is."""
    lines: list[str] = []
    cells = {name: sizes for name, sizes in found.items() if name.endswith("_nodes")}
    for name, sizes in cells.items():
        runs = {f"{size}, {each}": run for size, split in sizes.items() for each, run in split.items()}
        rates = {key: {what: value for what, value in run.items() if _is_figure(value)} for key, run in runs.items()}
        lines += [f"### {_named(name)}", "", *_together(f"ros.{name}", rates)]
    return lines + _part("ros", {name: value for name, value in found.items() if name not in cells})


def _targets(result: Mapping[str, Any]) -> list[str]:
    """Every figure that has a target."""
    found: list[tuple[str, str, str]] = []

    def look(name: str, group: Mapping[str, Any]) -> None:
        for key, value in group.items():
            if goal := _goal(group, key):
                found.append((f"`{name}.{key}`", figure(value), goal))
            elif isinstance(value, Mapping):
                look(f"{name}.{key}", value)

    for part in _TITLES:
        look(part, result.get(part, {}))
    return ["## Targets", "", *_table(("figure", "found", "target"), found)] if found else []


# ---- the page -----------------------------------------------------------------------------------------------------


def page(result: Mapping[str, Any]) -> str:
    """The page in Markdown, from a full result as `benchmarks.suite.store` keeps it."""
    machine = result.get("machine", {})
    where = f"{machine.get('processor', 'unknown')}, {machine.get('cores', '?')} cores"
    lines = [
        "# Performance",
        "",
        "`./lathe bench` measures; `./lathe bench --page COMMIT` writes this page.",
        "",
        f"- **Machine**: {where}; {machine.get('system', '')}, Python {machine.get('python', '?')}.",
        f"- **Commit**: `{result.get('commit', '?')}`{' (quick: rough figures)' if result.get('quick') else ''}.",
        "- **Figures** are medians on this machine, with the lowest and the highest run in brackets. Compared",
        "  sides were measured in turn (A B A B …). A **ratio** is the median of the quotients of all rounds; unlike",
        "  absolute figures it is reliable if the machine's speed varies.",
        *([f"- **Note**: {result['note']}"] if "note" in result else []),
        "",
        "`./lathe bench --against COMMIT` compares with a stored result; no test asserts a timing.",
        "",
        *_targets(result),
    ]
    for part in ("engine", "batch", "sweep", "ros", "real_time", "supervisor", "resimulation", "start"):
        if part in result:
            lines += [f"## {_TITLES[part]}", "", *_about(part)]
            lines += _ros(result[part]) if part == "ros" else _part(part, result[part])
    rows = list(_peer_rows(result))
    if rows:
        head = ("job", "peer", "`lathe_rc`", "peer's", "times as fast", "")
        lines += ["## Peers", "", "The table shows how many times as fast `lathe_rc` is as the peer.", ""]
        lines += _table(head, rows, texts=(0, 1, 5))
    for part in ("peers", "recorder", "viewer"):
        if part in result:
            # The table above has their figures.
            lines += [f"### {_TITLES[part]}", "", *_about(part)]
    if "growth" in result:
        lines += [f"## {_TITLES['growth']}", "", *_about("growth"), *_growth(result["growth"])]
    known = {*_TITLES, "commit", "machine", "quick"}
    for part, found in result.items():
        if part not in known and isinstance(found, Mapping):
            lines += [f"## {_named(part)}", "", *_part(part, found)]
    if _NOTES.exists():
        lines += ["## What limits it", "", _NOTES.read_text(encoding="utf-8").strip(), ""]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"
