# SPDX-License-Identifier: Apache-2.0
"""Parameters of the supervisor: what it watches, with which thresholds, and what it asks for beyond them."""

from typing import Annotated, Literal

from annotated_types import Ge, Le

from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.extensions import Named, Registry
from lathe_rc.safety.monitors import PlainMonitor

Asked = Literal["warn", "freeze", "fall_back", "hold", "retract", "stop"]

#: by name, those of other packages: ours have thresholds of their own
MONITORS: Registry[PlainMonitor] = Registry("monitor", PlainMonitor, {}, "lathe_rc.monitors")


class SupervisorParameters(NodeParameters):
    """Thresholds, each 0 for a monitor that is off, and what is asked for beyond them."""

    drives: list[str] = parameter(
        [], "drives of the tool that are watched, by the names of their topics; the first takes the tool out"
    )
    slides: list[Literal["cross", "longitudinal"]] = parameter([], "slides that are watched")

    speed_limit: Annotated[float, Ge(0)] = parameter(
        0.0, "encoder: measured speed, deviation from the nominal", "rad/s"
    )
    speed_reaction: Asked = parameter("stop", "what is asked for then")
    acceleration_limit: Annotated[float, Ge(0)] = parameter(0.0, "encoder: change of the measured speed", "rad/s^2")
    acceleration_window: Annotated[int, Ge(1), Le(65536)] = parameter(640, "over so many samples", "sample")
    acceleration_reaction: Asked = parameter("stop", "what is asked for then")
    index_limit: Annotated[float, Ge(0), Le(3)] = parameter(
        0.0, "encoder: measured angle from index pulse to index pulse, deviation from a revolution", "rad"
    )
    index_reaction: Asked = parameter("retract", "what is asked for then")
    following_limit: list[Annotated[float, Ge(0)]] = parameter(
        [], "drives: command - measured position, the drive's own lag included; one for each, or none", "m"
    )
    following_time: Annotated[float, Ge(0)] = parameter(1e-3, "for so long", "s")
    following_reaction: Asked = parameter("retract", "what is asked for then")
    stroke_limit: list[Annotated[float, Ge(0)]] = parameter(
        [], "drives: measured position to each side; one for each, or none", "m"
    )
    stroke_reaction: Asked = parameter("retract", "what is asked for then")
    effort_limit: list[Annotated[float, Ge(0)]] = parameter(
        [], "drives: current or voltage at which one is taken to be saturated; one for each, or none", "A or V"
    )
    effort_time: Annotated[float, Ge(0)] = parameter(5e-3, "for so long", "s")
    effort_reaction: Asked = parameter("freeze", "what is asked for then")
    error_limit: Annotated[float, Ge(0)] = parameter(0.0, "tool: measured error", "m")
    error_after: Annotated[float, Ge(0)] = parameter(
        10.0, "after so many from the start or a reset: they are there to learn", "rev"
    )
    error_reaction: Asked = parameter("retract", "what is asked for then")
    growth_limit: Annotated[float, Ge(0)] = parameter(
        0.0, "tool: RMS error of a revolution over that of the one before"
    )
    growth_cycles: Annotated[int, Ge(1), Le(1000)] = parameter(3, "so many times in a row", "rev")
    growth_floor: Annotated[float, Ge(0)] = parameter(1e-6, "RMS error that does not count", "m")
    growth_reaction: Asked = parameter("freeze", "what is asked for then")
    margin_limit: list[Annotated[float, Ge(0)]] = parameter(
        [],
        "drives: smallest stability margin of the channel that commands one, which has publish_margin; one for each, "
        "or none",
    )
    margin_after: Annotated[float, Ge(0)] = parameter(
        10.0, "after so many from the start or a reset: the drive has to be identified", "rev"
    )
    margin_reaction: Asked = parameter("freeze", "what is asked for then")
    force_limit: Annotated[float, Ge(0)] = parameter(0.0, "cut: measured force", "N")
    force_time: Annotated[float, Ge(0)] = parameter(1e-3, "for so long", "s")
    force_low: Annotated[float, Ge(0)] = parameter(0.0, "cut: measured force below this is lost", "N")
    force_after: Annotated[float, Ge(0)] = parameter(10.0, "after so many from the start or a reset", "rev")
    force_reaction: Asked = parameter("retract", "what is asked for beyond either")
    slide_limit: list[Annotated[float, Ge(0)]] = parameter(
        [], "slides: measured position to each side; one for each, or none", "m"
    )
    slide_reaction: Asked = parameter("hold", "what is asked for then")
    monitors: list[Annotated[str, Named(MONITORS)]] = parameter([], "monitors of others")
    monitor_signals: list[str] = parameter(
        [], "what each of them watches, as TOPIC.FIELD, like tool.measured_error or coarse/state.effort"
    )
    monitor_others: list[str] = parameter(
        [], "a second signal for each, an empty text where there is none; empty: for none of them"
    )
    monitor_limits: list[float] = parameter([], "threshold of each, in the unit of what it finds")
    monitor_reactions: list[Asked] = parameter([], "what each of them asks for")

    clear_position: Annotated[float, Ge(0)] = parameter(
        0.25e-3, "the tool is out of the part where the first drive's measured position is beyond this", "m"
    )
    clear_time: Annotated[float, Ge(0)] = parameter(1e-3, "for so long", "s")
