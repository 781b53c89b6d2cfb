# SPDX-License-Identifier: Apache-2.0
"""Head of a report: whether the part is in tolerance, failures and faults, and the causes that limit the form error.

A single pass over the bag yields the data: the final form error, its repeatable part, the spindle speed and the events
of the nodes. Only a budget gives the share of each cause.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lathe_rc import messages
from lathe_rc.analysis.budget import Budget
from lathe_rc.cell.events import LIMITED, parse
from lathe_rc.judge.causes import changing
from lathe_rc.view.form_limits import WARN, Finding, form_limits, varying_speed
from lathe_rc.view.report_figures import um
from lathe_rc.view.report_form import FormByRevolution
from lathe_rc.view.report_gather import EventKind, Gathered

GOOD, BAD = "good", "bad"

_MOST = 6  # largest number of kinds of incidents


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
        limits.append(Finding(_sentence(made_of.warning) if made_of.warning else text))
    for kind in data.curves.kinds.values():
        if parse(kind.text).verb == LIMITED:
            node = kind.topic.strip("/").removesuffix("/events")
            limits.append(Finding(f"{node} came to the limits of its command, {_when(data, kind)}.", WARN))
    if form and not incidents and not growth:  # otherwise incidents or growth determine the form error
        limits += _form(data, form)
    verdict = _verdict(data, form) if form or not data.servos else None
    verdict = _with_loops(data, verdict)
    if growth:
        mood = BAD if growth.diverges or verdict.mood == BAD else WARN
        verdict = Finding(f"{_sentence(growth.told())} {verdict.text}", mood)
    if data.doubt:
        verdict = Finding(f"Not judged to its end: {data.doubt}. Without that: {verdict.text}", BAD)
    return Assessment(verdict, wrong, limits)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _verdict(data: Gathered, form: FormByRevolution | None) -> Finding:
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


def _form(data: Gathered, form: FormByRevolution) -> Iterator[Finding]:
    """Yield findings on the final form error and on its repeatable and variable parts."""
    speeds = (series.extremes for (_, name), series in data.curves.signals.items() if name == "speed_true")
    yield from form_limits(
        um(np.array(form.newest)),
        excess=form.verdict.largest / form.verdict.tolerance if form.verdict else 0.0,
        learning=data.has(messages.LEARNING),
        causes=[
            *changing(data.nodes),
            *(["cut"] if data.has(messages.CUT) else []),
            *varying_speed(*next(speeds, (0.0, 0.0))),
        ],
    )
