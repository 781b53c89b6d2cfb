# SPDX-License-Identifier: Apache-2.0
"""Tool and part: desired form, displacement, form error."""

from collections.abc import Mapping
from itertools import repeat
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, MinLen

from lathe_machine.signals.error_motion import add_motion
from lathe_machine.signals.profile_table import Demand
from lathe_machine.signals.tip_path import steepest_fall
from lathe_machine.stages.drive.drive import Drive, MotionLimits
from lathe_machine.stages.tool.form import Form, FormParameters, FormTable, ProfileStage, evaluate
from lathe_rc import messages
from lathe_rc.arrays import put
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.judged import Judged
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Value, Values, parameter, remapped
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage, WiredCell
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.signals.zones import Zone

_TURN = 2.0 * np.pi
_ZONE = ("zone_start", "zone_width", "zone_tolerance", "zone_bottom", "zone_top")
_MOTION = ("error_motion_order", "error_motion_amplitude", "error_motion_phase")


class ToolParameters(FormParameters):
    """Drives that move the tool, and the desired form of the part unless a profile node publishes it."""

    reference: Literal["own", "topic"] = parameter(
        "own", "own: the form below; topic: what a profile node publishes, which others can read before the tool"
    )
    drives: Annotated[list[str], MinLen(1)] = parameter(
        ["coarse"], "what moves the tool against the part, by the first word of its state topic; motions add up"
    )
    cross_slide: bool = parameter(
        default=False,
        doc="the cross slide, positive into the part, counts in the form error; no drive's sensor sees it",
    )
    nose_radius: NonNegative = parameter(
        0.0, "radius of its nose in the plane of the feed: the result tells the roughness along the part; 0: not", "m"
    )
    deflects: bool = parameter(
        default=False, doc="the deflection by the cutting force is part of the form error; no drive's sensor sees it"
    )
    deflection_delay: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        64,
        "deflects: delay of the feedback edge from the cut, at least a block; 0 where the cut does not read the tool",
        "sample",
    )
    error_motion_order: list[Annotated[int, Ge(2), Le(2000)]] = parameter(
        [], "error motion of the spindle against the tool, which no sensor sees: waves per revolution"
    )
    error_motion_amplitude: list[float] = parameter([], "their amplitudes, positive towards the tool", "m")
    error_motion_phase: list[float] = parameter([], "their phases at angle 0; empty: all 0", "rad")
    tolerance: NonNegative = parameter(
        0.0, "form error that is allowed to each side, for the verdict on a run; 0: none is given", "m"
    )
    zone_start: list[float] = parameter([], "zones with tolerances of their own: angle where each begins", "rad")
    zone_width: list[Annotated[float, Gt(0), Le(_TURN)]] = parameter([], "their widths", "rad")
    zone_tolerance: list[NonNegative] = parameter(
        [], "form error that is allowed in each, the first of several at a place; 0: not judged", "m"
    )
    zone_bottom: list[float] = parameter([], "height along the part where each begins; empty: every height", "m")
    zone_top: list[float] = parameter([], "height where each ends", "m")

    judging = frozenset({"tolerance", *_ZONE})

    def model_post_init(self, context: Any, /) -> None:
        """Reject zones and error motions whose lists do not fit together, and zones without a tolerance elsewhere."""
        super().model_post_init(context)
        for names in (_ZONE[:3], _ZONE[3:], _MOTION[:2]):
            lengths = [len(getattr(self, name)) for name in names]
            if len(set(lengths)) > 1:
                raise InputError(f"{', '.join(names)}: lengths {lengths}; allowed: as many of each")
        for name, of in ((_ZONE[3], _ZONE[0]), (_MOTION[2], _MOTION[0])):
            if getattr(self, name) and len(getattr(self, name)) != len(getattr(self, of)):
                raise InputError(f"{name}: {len(getattr(self, name))} values; allowed: none, or as many as of {of}")
        for bottom, top in zip(self.zone_bottom, self.zone_top, strict=True):
            if not top > bottom:
                raise InputError(f"zone_top = {top:g} m with zone_bottom = {bottom:g} m; allowed: above it")
        if self.zone_start and not self.tolerance:
            raise InputError("tolerance = 0 with zones; allowed: above 0, for the surface outside of them")

    @property
    def zones(self) -> tuple[Zone, ...]:
        """Zones with tolerances of their own."""
        found = zip(self.zone_start, self.zone_width, self.zone_tolerance, strict=True)
        heights = zip(self.zone_bottom, self.zone_top, strict=True) if self.zone_bottom else repeat((0.0, 0.0))
        return tuple(Zone(*of, *span) for of, span in zip(found, heights, strict=False))

    def causes_off(self, node: str, nodes: Mapping[str, NodeParameters], height: Samples) -> dict[str, Values]:
        """Return the causes of a tool with a form of its own (extends `FormParameters`)."""
        return {} if self.reference == "topic" else super().causes_off(node, nodes, height)

    def known(self) -> Mapping[str, Value]:
        """Form of the part for control laws, unless a profile node provides it."""
        return super().known() if self.reference == "own" else {}

    def judged(self) -> Judged:
        """Form error of the tool."""
        return Judged(remapped(self, "tool"), "form", self.step, self.tolerance, self.nose_radius, zones=self.zones)

    def shown(self) -> Mapping[str, Any]:
        """Part, tolerance and feed of the tool; drawings have no tolerance that differs by zone."""
        return {
            "part": True,
            "tolerance": 0.0 if self.zone_start else self.tolerance * 1e6,
            "by_zone": bool(self.zone_start),
            "fed": bool(self.feed or self.height_from == "slide"),
            "feed": self.feed if self.height_from == "feed" else 0.0,
            "radius": self.part_radius * 1e3,
        }


class Memory(NamedTuple):
    """State of the tool's step function.

    Attributes:
        form: form of the part; without a table if a profile node provides it.
        begin: index of the first input of the drives.
        drives: number of drives, each with a true and a measured position.
        cross_slide, deflects: whether inputs of the cross slide and the edge's deflection follow those of the drives.
        error_motion: waves, amplitudes and phases of the spindle's error motion, shape (3, n); the true angle is the
            last input if there are any.
    """

    form: FormTable
    begin: int
    drives: int
    cross_slide: bool
    deflects: bool
    error_motion: Samples


@kernel
def add_drive(
    begins: bool,  # noqa: FBT001 - kernels take their arguments by position
    reference: Samples,
    expected: Samples,
    position: Samples,
    measured: Samples,
    displacement: Samples,
    known: Samples,
    error: Samples,
) -> None:
    """Add the motion of a drive; all arrays in m, shape (n,). The first drive (``begins``) starts the sum.

    The error is Xd - X of the true signals (paper 000, Fig. 1); the known error is the expected form at the measured
    angle minus the measured motions.
    """
    for k in range(reference.size):
        displacement[k] = position[k] if begins else displacement[k] + position[k]
        known[k] = (expected[k] if begins else known[k]) - measured[k]
        error[k] = reference[k] - displacement[k]


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Sum the motions of one block, and compare the sum with the form."""
    reference, displacement, error, known, height = outputs
    if memory.form.heights.size:
        evaluate(memory.form, inputs, reference, known, height)
    else:
        put(reference, inputs[0])
        put(known, inputs[1])
        put(height, inputs[2])
    place = memory.begin
    for drive in range(memory.drives):
        add_drive(drive == 0, reference, known, inputs[place], inputs[place + 1], displacement, known, error)
        place += 2
    if memory.cross_slide:
        position = inputs[place]
        for k in range(error.size):
            error[k] += position[k]
        place += 1
    if memory.deflects:
        deflection = inputs[place]
        for k in range(error.size):
            error[k] -= deflection[k]
        place += 1
    if memory.error_motion.shape[1]:
        add_motion(memory.error_motion, inputs[place], error)
    return error.size, DONE


_ELSEWHERE = FormTable(
    heights=np.empty(0),
    table=np.empty((0, 0, 0)),
    told=np.empty((0, 0, 0)),
    alike=True,
    slide=0,
    feed=0.0,
    start=0.0,
    part=0,
    told_heights=np.empty(0),
)


class Tool(Stage):
    """Tool position as the sum of the motions (paper 001, Fig. 1a), compared with the desired form.

    Attributes:
        form: form of the part; None if a profile node provides it.
    """

    kind = "tool"
    Parameters = ToolParameters
    parameters: ToolParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: ToolParameters) -> None:
        super().__init__(name, parameters)
        self.form = Form(name, parameters) if parameters.reference == "own" else None
        if len(set(parameters.drives)) < len(parameters.drives):
            raise InputError(f"{name}.drives = {parameters.drives}; allowed: each drive once")
        what = [Input("reference", messages.REFERENCE, ("reference", "expected", "height"))]
        if self.form is not None:
            what = self.form.inputs
        inputs = what + [
            Input(f"{drive}/state", messages.STATE, ("position", "measured_position")) for drive in parameters.drives
        ]
        if parameters.cross_slide:
            inputs.append(Input("cross/state", messages.STATE, ("position",)))
        if parameters.deflects:
            inputs.append(Input("cut", messages.CUT, ("deflection",), parameters.deflection_delay))
        orders = parameters.error_motion_order
        phases = parameters.error_motion_phase or [0.0] * len(orders)
        self._error_motion = np.array([orders, parameters.error_motion_amplitude, phases], dtype=float).reshape(3, -1)
        if orders:
            inputs.append(Input("encoder", messages.ENCODER, ("angle_true",)))
        self.declare(inputs=inputs, outputs=[Output("tool", messages.TOOL, Joint("displacement"))])

    def warnings(self, seconds: float) -> list[str]:
        """Return the warnings about the form, one line each."""
        return self.form.warnings(self.name, self.parameters.tolerance) if self.form else []

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check that the first drive can follow the profile and that the flank does not rub."""
        super().check_cell(cell, cures=cures)
        owner = self._form_owner(cell)
        topic = remapped(self.shared, f"{self.parameters.drives[0]}/state")
        source = cell.publisher(topic, f"whether {cell.node_of(topic)} can follow the profile of {self.name}")
        if source and source.relayed:
            topic = remapped(source.shared, source.relayed)
            source = cell.publisher(topic, f"whether {cell.node_of(topic)} can follow the profile of {self.name}")
        if owner is None or owner.form is None:
            return
        if isinstance(source, Drive):
            speed, acceleration = cell.speed_range[1], cell.master.largest_acceleration()
            demand = owner.form.profile.demand(speed, acceleration, owner.parameters.feed)
            for of, limits in source.limits().items():
                if remapped(source.shared, of) == topic:
                    _check_demand(owner.name, source.name, demand, limits, speed)
        if owner.parameters.clearance:
            _check_flank(owner.name, owner.parameters, owner.form)

    def _form_owner(self, cell: WiredCell) -> "Tool | ProfileStage | None":
        """Return the stage that provides the tool's desired form."""
        if self.form is not None:
            return self
        source = cell.publisher(
            remapped(self.shared, "reference"), f"whether a drive can follow what {self.name} reads"
        )
        return source if isinstance(source, ProfileStage) else None

    @property
    def memory(self) -> Memory:
        """Current state of the tool's step function."""
        parameters = self.parameters
        form = self.form.table if self.form else _ELSEWHERE
        # Each input of a form has two fields; that of a profile node has three.
        begin = 3 if self.form is None else 2 * len(self.form.inputs)
        drives = len(parameters.drives)
        return Memory(form, begin, drives, parameters.cross_slide, parameters.deflects, self._error_motion)


def _check_demand(owner: str, drive: str, demand: Demand, limits: MotionLimits, speed: float) -> None:
    """Check that a drive can follow a profile at a speed [rad/s]."""
    for what, asked, allowed, unit in (
        ("stroke", demand.stroke * 1e6, limits.stroke * 1e6, "µm"),
        ("velocity", demand.velocity, limits.velocity, "m/s"),
        ("acceleration", demand.acceleration, limits.acceleration, "m/s^2"),
    ):
        if asked > allowed:
            raise InputError(
                f"{owner}.profile: {drive} cannot follow it at {speed:.4g} rad/s: {what} "
                f"{asked:.4g} {unit}; allowed: {allowed:.4g} {unit} (turn slower or change the form)"
            )


def _check_flank(owner: str, parameters: FormParameters, form: Form) -> None:
    """Check that the flank clears the surface behind the edge."""
    fall = steepest_fall(form.surface, parameters.part_radius, parameters.feed)
    if fall.clearance >= parameters.clearance:
        raise InputError(
            f"{owner}.clearance = {parameters.clearance:g} rad: the tool's flank would rub, since the form falls "
            f"by {fall.clearance:.4g} rad at {fall.angle:.4g} rad, height {fall.height:g} m; allowed: above that, or a "
            "flatter form"
        )
