# SPDX-License-Identifier: Apache-2.0
"""Head of a report: whether the part is in tolerance, failures and faults, and the causes that limit the form error.

A single pass over the bag yields the data: the final form error, its repeatable part, the spindle speed and the events
of the nodes. Only a budget gives the share of each cause.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lathe_rc import messages
from lathe_rc.analysis.budget import Budget
from lathe_rc.cell.budget import changing
from lathe_rc.cell.stages.command_limits import LIMITED
from lathe_rc.view.report_figures import um
from lathe_rc.view.report_form import Form
from lathe_rc.view.report_gather import EventKind, Gathered

GOOD, BAD, WARN = "good", "bad", "warn"

_FEWEST = 4  # smallest number of revolutions for a trend
_CHANGE = 0.05  # change of the form error over the last revolutions below which it counts as constant
_VARIES = 0.005  # smallest relative deviation at which a speed counts as varying
_SOME = 0.1  # smallest share of the power that is reported
_MOST = 6  # largest number of kinds of incidents


@dataclass(frozen=True)
class Finding:
    """Finding of the report: a sentence, and whether it is good or bad news."""

    text: str
    mood: str = ""


@dataclass(frozen=True)
class Assessment:
    """Contents of the report's head.

    Attributes:
        verdict: whether the part is in tolerance.
        wrong: failures and faults.
        limits: causes that limit the form error, most important first.
    """

    verdict: Finding
    wrong: Sequence[Finding]
    limits: Sequence[Finding]


def assess(data: Gathered, losses: Sequence[str], made_of: Budget | None) -> Assessment:
    """Assess the run from the data of its bag.

    Args:
        data: data gathered from the bag.
        losses: rejected messages, losses and failures, one line each.
        made_of: budget of the form error, if requested.
    """
    form = next(iter(data.forms), None)
    incidents = list(_incidents(data))
    growth = form.growth if form else None
    wrong = [Finding(text, BAD) for text in [*incidents, *losses]]
    limits = []
    if made_of:
        largest = max((*made_of.causes, made_of.rest), key=lambda part: part.share)
        text = f"The largest cause, by the budget below: {largest.name}, {largest.percent()} % of the power."
        limits.append(Finding(text))
    for kind in data.curves.kinds.values():
        if kind.text.startswith(LIMITED):
            node = kind.topic.strip("/").removesuffix("/events")
            limits.append(Finding(f"{node} came to the limits of its command, {_when(data, kind)}.", WARN))
    if form and not incidents and not growth:  # otherwise incidents or growth determine the form error
        limits += _form(data, form)
    verdict = _verdict(data, form) if form or not data.servos else None
    verdict = _with_loops(data, verdict)
    if growth:
        mood = BAD if growth.diverges or verdict.mood == BAD else WARN
        verdict = Finding(f"{_sentence(growth.told())} {verdict.text}", mood)
    return Assessment(verdict, wrong, limits)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _verdict(data: Gathered, form: Form | None) -> Finding:
    if form is None:
        return Finding(f"No form to judge: {data.missing}.")
    if form.refused or form.last is None:
        return Finding("Not judged: the form cannot be measured to its end.", BAD)
    if form.verdict is None:
        last = form.last.numbers
        return Finding(
            f"No tolerance to judge by: the form error of the last revolution is {last['rms']:.3g} µm RMS, "
            f"{last['max']:.3g} µm at most."
        )
    return Finding(_sentence(form.verdict.told()), GOOD if form.verdict.in_tolerance else BAD)


def _with_loops(data: Gathered, verdict: Finding | None) -> Finding:
    """Return the verdict on the form, if there is one, together with those on the force and position loops."""
    texts, moods = ([verdict.text], [verdict.mood]) if verdict else ([], [])
    for servo in data.servos:
        for text, good in servo.result.judged():
            texts.append(f"{servo.loop.node}: {text}.")
            moods.append("" if good is None else GOOD if good else BAD)
    return Finding(" ".join(texts), BAD if BAD in moods else GOOD if GOOD in moods else "")


def _when(data: Gathered, kind: EventKind) -> str:
    """Return the time of an event, or the time span of several."""
    first, last = (sample * data.step_ns * 1e-9 for sample in (kind.first, kind.last))
    if kind.count == 1:
        return f"at {first:.4g} s"
    return f"{kind.count} times from {first:.4g} s to {last:.4g} s"


def _incidents(data: Gathered) -> Iterator[str]:
    """Yield faults and reactions of the supervisor."""
    kinds = [kind for kind in data.curves.kinds.values() if kind.text.startswith("fault ") or kind.alarm]
    for kind in kinds[:_MOST]:
        yield f"{kind.topic.strip('/')}: {kind.text}, {_when(data, kind)}"
    if len(kinds) > _MOST:
        yield f"{len(kinds) - _MOST} further kinds of faults and alarms, see the events"


def _form(data: Gathered, form: Form) -> Iterator[Finding]:
    """Yield findings on the final form error and on its repeatable and variable parts."""
    profiles = um(np.array(form.newest))
    if len(profiles) < _FEWEST:
        return
    rms = np.sqrt(np.mean(profiles**2, axis=-1))
    power = float(np.mean(profiles**2))
    if not power:
        return
    yield from _trend(rms, form)
    count = len(profiles)
    # The mean of count revolutions still contains 1/count of the variable power; the factor corrects this.
    mean = profiles.mean(axis=0)
    share = min(float(np.mean((profiles - mean) ** 2)) * count / (count - 1) / power, 1.0)
    amplitude = np.abs(np.fft.rfft(mean)) * 2.0 / mean.size
    order = int(np.argmax(amplitude[1:])) + 1
    left = ": what learning and its Q filter leave" if data.has(messages.LEARNING) else ""
    causes = [*changing(data.nodes), *(["cut"] if data.has(messages.CUT) else []), *_speed(data)]
    parts = [
        (1.0 - share, f"repeats from revolution to revolution, most at {order} UPR ({amplitude[order]:.3g} µm){left}"),
        (share, f"changes from revolution to revolution{': ' if causes else ''}{', '.join(causes)}"),
    ]
    for part, text in sorted(parts, reverse=True):
        if part >= _SOME:
            yield Finding(f"{part:.0%} of the form error's power in the last {count} revolutions {text}.")


def _trend(rms: messages.Samples, form: Form) -> Iterator[Finding]:
    """Yield a finding on the trend of the form error, if the error clearly falls or grows in the last revolutions."""
    half = len(rms) // 2
    before, after = rms[:half], rms[-half:]
    factor = float(after.mean() / before.mean()) if before.mean() else 1.0
    each = float(np.median(rms[1:] / rms[:-1])) if rms.all() else 1.0  # a step is not a trend
    if after.max() < before.min() and factor < 1.0 - _CHANGE and each < 1.0:
        more = ""
        if form.verdict and not form.verdict.in_tolerance:
            turns = math.ceil(math.log(form.tolerance / form.verdict.largest) / math.log(each))
            more = f"; in tolerance after some {turns} more, if it goes on like this"
        yield Finding(f"Learning is not over: the form error falls by {1.0 - each:.1%} a revolution{more}.", WARN)
    elif after.min() > before.max() and factor > 1.0 + _CHANGE and each > 1.0:
        yield Finding(f"The form error grows by {each - 1.0:.1%} a revolution in the last {len(rms)}.", WARN)


def _speed(data: Gathered) -> Iterator[str]:
    """Yield the variation of the spindle speed, if it is large enough."""
    for (_, name), series in data.curves.signals.items():
        low, high = series.extremes
        if name == "speed_true" and low > 0.0 and math.isfinite(high):
            deviation = (high - low) / (high + low)
            if deviation >= _VARIES:
                yield f"speed (which varies by ±{deviation:.1%})"
            return
