# SPDX-License-Identifier: Apache-2.0
"""Numbers in messages of any type as columns of a measurement, ``TOPIC.PATH``, resampled to common even times.

A path names fields and elements: ``/commands.data[0]``, ``/joint_states.position[0]``; ``position[x]`` is the element
with the number that x has in the field ``name`` of the same message. The times are those in the headers or, for
messages without them, the log times.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from rosbags.interfaces import Nodetype

from lathe_rc import messages
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.blocks.columns import TEXT, flattened
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import Samples
from lathe_rc.signals import measurement_source
from lathe_rc.signals.measurement_source import Clock

_SI = "1"  # unit: ROS messages have SI units (REP 103)
_GAP = 10.0  # intervals between messages, over which nothing is known
_ALIASED = 1.5  # intervals of the faster column, from which resampling folds its content


class _Series(NamedTuple):
    """Values of a column at times [ns], and the clock of the times: header or log."""

    times: Samples
    values: Samples
    clock: str


class MessageColumns(measurement_source.MeasurementSource):
    """Columns of messages; those that are asked for are resampled, linear between messages, which is said on stderr.

    Args:
        path: path of the bag.
        asked: columns to read.
        by_log: whether the log times are used even if headers contain times.

    Raises:
        InputError: the path is not a bag, or an asked column cannot be read or resampled.
    """

    has_header = False

    def __init__(self, path: Path, asked: Collection[str], *, by_log: bool = False) -> None:
        self.units: dict[str, str] = {}
        with BagSource(path) as source:
            types = messages.store().fielddefs.keys() - messages.block_types()
            for topic, about in sorted(source.topics.items()):
                if about.count and about.type in types:
                    _, _, data = next(source.messages({topic}))
                    self.units |= {f"{topic}.{name}": _SI for name in _numbers(_decoded(path, topic, about.type, data))}
            known = self.units.keys() >= set(asked)
            series = {column: _series(source, column, by_log=by_log) for column in asked} if known else {}
        self._step_ns, self._columns = _resampled(path, series) if series else (0.0, {})

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, Samples]:
        """Return asked columns, shape (n,) each; none has ``gaps``."""
        return {name: self._columns[name] for name in names}

    def clock(self, name: str) -> Clock:
        """Return the sampling, which is that of all columns."""
        return Clock(0.0, self._step_ns * 1e-9)


def _decoded(path: Path, topic: str, msgtype: str, data: bytes) -> Any:
    try:
        return messages.decode(msgtype, data)
    except ValueError as error:
        raise LatheError(f"{path}: {topic}: {shown(error)}") from None


def _numbers(message: Any) -> dict[str, float]:
    """Return the numbers in a message by path; an element also by its name, if it has one."""
    found = {
        name: value for name, value, dtype in flattened(message) if dtype != TEXT and not name.startswith("header.")
    }
    names = getattr(message, "name", ())
    named = [] if isinstance(names, str) else [*enumerate(names)]
    for name in [*found]:
        found |= {name.replace(f"[{k}]", f"[{each}]"): found[name] for k, each in named if name.endswith(f"[{k}]")}
    return found


def _series(source: BagSource, column: str, *, by_log: bool) -> _Series:
    topic = max((topic for topic in source.topics if column.startswith(f"{topic}.")), key=len)
    msgtype, path = source.topics[topic].type, column.removeprefix(f"{topic}.")
    has_header = messages.fields(msgtype)[:1] == [("header", (Nodetype.NAME, "std_msgs/msg/Header"))]
    logged, stamped, values = [], [], []
    for _, log_ns, data in source.messages({topic}):
        message = _decoded(source.path, topic, msgtype, data)
        try:
            values.append(float(_numbers(message)[path]))
        except LookupError:
            raise InputError(
                f"{source.path}: {topic} at {log_ns} ns has no {path}; allowed: in every message"
            ) from None
        logged.append(log_ns)
        stamped.append(messages.stamp_ns(message) if has_header and not by_log else 0)
    clock = "header" if any(stamped) else "log"
    times = np.array(stamped if any(stamped) else logged, np.int64)
    if times.size < 2:
        raise InputError(f"{source.path}: {topic}: {times.size} messages; allowed: two or more")
    if (between := np.diff(times)).min() <= 0:
        at = int(np.argmax(between <= 0))
        cure = "record one sender, or the part without it" + ", or --column time=log" * (clock == "header")
        raise InputError(
            f"{source.path}: {topic}: the {clock} time of message {at + 2} is {between[at] * 1e-9:.9g} s after the one "
            f"before; allowed: times that rise ({cure})"
        )
    return _Series(times, np.array(values), clock)


def _step(times: Samples) -> float:
    """Return the interval between messages [ns]: the mean, or the median if some are missing."""
    between = np.diff(times)
    median = float(np.median(between))
    return float(np.mean(between)) if np.abs(between - median).max() < 0.5 * median else median


def _resampled(path: Path, series: Mapping[str, _Series]) -> tuple[float, dict[str, Samples]]:
    """Return the step [ns] of the slowest column, and the columns at common times."""
    steps = {column: _step(found.times) for column, found in series.items()}
    for column, found in series.items():
        between = np.diff(found.times)
        if between.max() > _GAP * steps[column]:
            at = (found.times[between.argmax()] - found.times[0]) * 1e-9
            raise InputError(
                f"{path}: no {column} for {between.max() * 1e-9:.4g} s from {at:.4g} s on; allowed: up to {_GAP:g} "
                f"intervals of {steps[column] * 1e-9:.4g} s (record the part without the gap)"
            )
    step = max(steps.values())
    first = max(int(found.times[0]) for found in series.values())
    last = min(int(found.times[-1]) for found in series.values())
    if last - first < step:
        spans = ", ".join(
            f"{c} ({f.clock} time) {f.times[0] * 1e-9:.3f} to {f.times[-1] * 1e-9:.3f} s" for c, f in series.items()
        )
        cure = " (--column time=log)" * any(found.clock == "header" for found in series.values())
        raise InputError(f"{path}: columns of different times: {spans}; allowed: recorded together, by one clock{cure}")
    count = int((last - first) / step) + 1
    end = first + step * (count - 1)
    columns = {
        column: np.interp(step * np.arange(count), (found.times - first).astype(float), found.values)
        for column, found in series.items()
    }
    told = ", ".join(_told(column, found, steps[column], first, end) for column, found in series.items())
    both = " (a delay between the two clocks is in the result)" * (len({f.clock for f in series.values()}) > 1)
    click.echo(
        f"lathe: note: {path}: resampled every {step * 1e-6:.6g} ms over {(end - first) * 1e-9:.4g} s, linear between "
        f"messages, in SI units: {told}{both}",
        err=True,
    )
    fastest = min(steps, key=lambda column: steps[column])
    if step > _ALIASED * steps[fastest]:
        click.echo(
            f"lathe: warning: {path}: {fastest} is resampled to {step * 1e-6:.6g} ms: its content above "
            f"{0.5e9 / step:.4g} Hz is in the result as lower frequencies",
            err=True,
        )
    return step, columns


def _told(column: str, found: _Series, step: float, first: int, end: float) -> str:
    """Return the clock of a column, its interval and unevenness, and the time of it outside the common one."""
    uneven = float(np.abs(np.diff(found.times) - step).max())
    told = f"{column} by {found.clock} time every {step * 1e-6:.6g} ms (uneven by up to {uneven * 1e-6:.3g} ms"
    left = {"first": (first - found.times[0]) * 1e-9, "last": (found.times[-1] - end) * 1e-9}
    outside = [f"the {which} {seconds:.4g} s" for which, seconds in left.items() if seconds * 1e9 > step]
    return told + (f", without {' and '.join(outside)})" if outside else ")")
