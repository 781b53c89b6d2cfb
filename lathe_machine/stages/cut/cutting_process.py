# SPDX-License-Identifier: Apache-2.0
"""Cutting process: from tool, feed and part to the force and the resulting deflection of the edge."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le, Lt

from lathe_machine.analysis.shaft import STEEL_MODULUS, Shaft, Support
from lathe_machine.plants.chip import STOPS, CutTable, failure
from lathe_machine.plants.cutting import CuttingProcess, cut_along
from lathe_machine.plants.cutting_force import PAPER, REALISTIC, RIGID, Elasticity, Flank, SpecificForce, Wear
from lathe_machine.plants.workpiece import HardSpot, Workpiece
from lathe_machine.signals.allowance import Allowance, AllowanceTable, allow, mean_reverting, unbounded
from lathe_machine.stages.common.tables import made_of
from lathe_rc import messages
from lathe_rc.arrays import put, put_scaled, subtract
from lathe_rc.blocks.ports import Input, Output, Sparse
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals
from lathe_rc.safety.faults import Fault
from lathe_rc.signals.noise import NormalStream, Sensor, SensorTable, measure

_ELASTICITIES = {"rigid": RIGID, "paper": PAPER, "realistic": REALISTIC}
READ = {
    "tool": Input("tool", messages.TOOL, ("displacement", "reference", "height")),
    "cross": Input("cross/state", messages.STATE, ("position",)),
    "longitudinal": Input("longitudinal/state", messages.STATE, ("position", "velocity")),
}
TURNS = Input("encoder", messages.ENCODER, ("angle_true", "speed_true"))
_HEIGHTS = 201  # positions along a shaft between which the compliance is interpolated linearly


class CuttingProcessParameters(NodeParameters):
    """Parameters of edge, material, blank and part, and of all compliant elements."""

    moved_by: list[Literal["tool", "cross", "longitudinal"]] = parameter(
        ["cross", "longitudinal"], "what moves the edge: the tool drives, the cross feed, the longitudinal feed"
    )
    blank: Literal["round", "form"] = parameter(
        "form",
        "what the tool drives meet: a round blank, or the form left by the pass before, so that the chip is even",
    )
    depth: NonNegative = parameter(0.0, "depth of cut with everything at 0 and an allowance of 0", "m")
    feed: NonNegative = parameter(71e-6, "feed, unless the longitudinal slide makes it", "m/rev")
    kc1: Positive = parameter(1.7e9, "specific force at a feed of 1 mm; steel", "Pa")
    mc: Annotated[float, Ge(0), Lt(1)] = parameter(0.25, "exponent of its fall with the feed")
    wear_factor: NonNegative = parameter(0.0, "relative rise of the force with the wear VB", "1/m")
    wear: NonNegative = parameter(0.0, "wear VB at sample 0", "m")
    wear_per_metre: NonNegative = parameter(0.0, "its growth with the cutting path", "1")
    wear_per_second: NonNegative = parameter(0.0, "its growth with the time in the cut", "m/s")
    flank_pressure: NonNegative = parameter(
        0.0, "process damping: force by the volume that the flank presses in; 4e13 for steel; 0: none", "N/m^3"
    )
    flank_width: Positive = parameter(0.2e-3, "process damping: width of the flank along the edge", "m")
    flank_land: NonNegative = parameter(0.05e-3, "process damping: land of a new edge, to which the wear VB adds", "m")
    lag: NonNegative = parameter(0.075, "time constant of the force; 0: none", "s")
    allowance_rms: NonNegative = parameter(
        0.0, "random allowance: RMS; 20.7e-6 is the 4.83 N RMS of paper 004; 0: none", "m"
    )
    allowance_time: Positive = parameter(1.0, "its correlation time", "s")
    allowance_rate: NonNegative = parameter(0.0, "instead: a walk without bounds, RMS after one second; 0: none", "m")
    run_out_order: list[Annotated[int, Ge(1), Le(2000)]] = parameter([], "run-out of the blank: waves a revolution")
    run_out_amplitude: list[float] = parameter([], "their amplitudes", "m")
    run_out_phase: list[float] = parameter([], "their phases at angle 0; empty: all 0", "rad")
    radius: Positive = parameter(0.05, "of the part, for the cutting path", "m")
    gap_start: list[float] = parameter([], "interrupted cut: where places without material begin", "rad")
    gap_width: list[Positive] = parameter([], "their widths", "rad")
    hard_spot_start: list[float] = parameter([], "hard spots: where they begin", "rad")
    hard_spot_width: list[Positive] = parameter([], "their widths", "rad")
    hard_spot_bottom: list[float] = parameter([], "their lower ends along the part", "m")
    hard_spot_top: list[float] = parameter([], "their upper ends along the part", "m")
    hard_spot_factor: list[NonNegative] = parameter([], "factor of the force in them")
    regeneration: Annotated[float, Ge(0), Le(1)] = parameter(
        0.0, "overlap µ with the surface of the last revolution; 0: off"
    )
    elasticity: Literal["rigid", "paper", "realistic"] = parameter(
        "realistic", "deflection W3 of the edge by the force; paper: as printed, 2.9 Hz and drawn into the part"
    )
    shaft: Literal["none", "centres", "chuck_and_centre", "chuck"] = parameter(
        "none", "none: the compliance of W3 all along; otherwise that of a shaft and what holds it"
    )
    shaft_length: Positive = parameter(0.5, "shaft: length", "m")
    shaft_diameter: Positive = parameter(0.03, "shaft: diameter", "m")
    shaft_head: Positive = parameter(1e8, "shaft: stiffness of the head stock", "N/m")
    shaft_tail: Positive = parameter(5e7, "shaft: stiffness of the tail stock", "N/m")
    shaft_carriage: Positive = parameter(1e8, "shaft: stiffness of the carriage", "N/m")
    shaft_modulus: Positive = parameter(STEEL_MODULUS, "shaft: modulus of elasticity", "Pa")
    noise_rms: NonNegative = parameter(0.0, "white noise of the force sensor, RMS; 0: none", "N")
    resolution: NonNegative = parameter(0.0, "quantisation step of the force sensor; 0: none", "N")

    def allowance(self, node: str, prefix: str = "") -> Allowance:
        """Return the machining allowance of a node; ``prefix`` precedes its parameters in a composed table."""
        if self.allowance_rms and self.allowance_rate:
            raise InputError(
                f"{node}.{prefix}allowance_rms and {prefix}allowance_rate are both given; allowed: one of them"
            )
        walk = unbounded(self.allowance_rate, self.step)
        if not self.allowance_rate:
            walk = mean_reverting(self.allowance_rms, self.allowance_time, self.step)
        with about(node, *(f"{prefix}run_out_{what}" for what in ("order", "amplitude", "phase"))):
            return Allowance(
                walk,
                order=np.array(self.run_out_order, dtype=float),
                amplitude=np.array(self.run_out_amplitude),
                phase=np.array(self.run_out_phase or [0.0] * len(self.run_out_order)),
                seed=self.seed,
                name=node,
            )

    def flexible(self) -> Shaft | None:
        """Flexible shaft, if there is one."""
        if self.shaft == "none":
            return None
        support: Support = self.shaft
        return made_of(Shaft, self, "shaft_", support=support)

    def part(self, node: str, prefix: str = "") -> Workpiece:
        """Return the part of a node; ``prefix`` precedes its parameters in a composed table.

        Raises:
            InputError: lists differ in length, or a window is invalid.
        """
        names = [f"hard_spot_{what}" for what in ("start", "width", "bottom", "top", "factor")]
        spots = [getattr(self, name) for name in names]
        if len(self.gap_start) != len(self.gap_width):
            raise InputError(
                f"{node}.{prefix}gap_start, {prefix}gap_width: {len(self.gap_start)} and {len(self.gap_width)}; give "
                "as many of each"
            )
        if len({len(values) for values in spots}) > 1:
            named = ", ".join(prefix + name for name in names)
            raise InputError(f"{node}.{named}: of lengths {[len(v) for v in spots]}; give as many of each")
        heights = compliances = None
        shaft = self.flexible()
        if shaft is not None:
            heights = np.linspace(0.0, shaft.length, _HEIGHTS)
            compliances = shaft.compliance(heights)
        with about(node, *(prefix + name for name in names[:-1])):
            hard_spots = [HardSpot(*spot) for spot in zip(*spots, strict=True)]
        with about(node, f"{prefix}gap_start", f"{prefix}gap_width"):
            return Workpiece(
                radius=self.radius,
                gaps=list(zip(self.gap_start, self.gap_width, strict=True)),
                hard_spots=hard_spots,
                heights=heights,
                compliances=compliances,
            )

    def deflecting(self) -> Elasticity:
        """Transfer function W3; for a shaft, only its dynamics, since the compliance is that of the shaft itself."""
        return _ELASTICITIES["realistic" if self.shaft != "none" and self.elasticity == "rigid" else self.elasticity]

    def process(self, node: str, prefix: str = "") -> CuttingProcess:
        """Return the cutting process of a node in its initial state (arguments as for `part`)."""
        part = self.part(node, prefix)
        with about(node, f"{prefix}lag"):
            return made_of(
                CuttingProcess,
                self,
                material=made_of(SpecificForce, self),
                elasticity=self.deflecting(),
                wear=made_of(Wear, self, "wear_", initial=self.wear),
                part=part,
                overlap=self.regeneration,
                flank=made_of(Flank, self, "flank_"),
            )

    def shown(self) -> Mapping[str, Any]:
        """Cut, radius of the part, and places without material."""
        gaps = list(zip(self.gap_start, self.gap_width, strict=True))
        return {"cut": True, "cut_radius": self.radius * 1e3, "gaps": gaps}


class Memory(NamedTuple):
    """State of the cutting process's step function.

    Attributes:
        cut: simulated cutting process.
        allowance: machining allowance of the blank.
        sensor: sensor of the force.
        tool, cross, longitudinal: index of the first input of each device; -1 if the device does not move the edge.
        even: whether the blank already has the desired form.
        feed: constant feed if there is no longitudinal slide [m/rad].
        room: scratch arrays for displacement, position of the cross slide, feed velocity and height.
    """

    cut: CutTable
    allowance: AllowanceTable
    sensor: SensorTable
    tool: int
    cross: int
    longitudinal: int
    even: bool
    feed: float
    room: Samples


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Compute the cut through one block; the cross feed is positive into the part."""
    angle, speed = inputs[0], inputs[1]
    force, measured_force, depth_of_cut, feed, allowance, wear, deflection = outputs
    n = angle.size
    displacement, cross_position, feed_velocity = memory.room[0, :n], memory.room[1, :n], memory.room[2, :n]
    height = memory.room[3, :n]
    # A device that does not move the edge is taken to be at rest.
    displacement[:] = cross_position[:] = height[:] = 0.0
    if memory.tool >= 0:
        height = inputs[memory.tool + 2]
        put(displacement, inputs[memory.tool])
        if memory.even:
            subtract(displacement, inputs[memory.tool + 1])
    if memory.cross >= 0:
        put_scaled(cross_position, -1.0, inputs[memory.cross])
    if memory.longitudinal >= 0:
        height, feed_velocity = inputs[memory.longitudinal], inputs[memory.longitudinal + 1]
    else:
        put_scaled(feed_velocity, memory.feed, speed)
    allow(memory.allowance, angle, allowance)
    given = (angle, speed, height, cross_position, displacement, feed_velocity, allowance)
    reached, reason = cut_along(memory.cut, given, (force, deflection, depth_of_cut, feed, wear))
    if reason != DONE:
        return reached, reason
    measure(memory.sensor, force, measured_force)
    return reached, DONE


class CutStage(Stage):
    """Stage with a cut; its first input is the encoder, and its last output is the cut.

    Attributes:
        cut: simulated cutting process.
    """

    devices = ("cut",)
    stops = STOPS
    failure = staticmethod(failure)  #: function that explains why the cut cannot continue

    def __init__(self, name: str, parameters: NodeParameters, table: CuttingProcessParameters, prefix: str) -> None:
        super().__init__(name, parameters)
        if len(set(table.moved_by)) < len(table.moved_by):
            raise InputError(f"{name}.{prefix}moved_by = {table.moved_by}; allowed: each once")
        self._allowance = table.allowance(name, prefix)
        self._force_sensor = Sensor(table.noise_rms, table.resolution, table.seed, f"{name}{prefix and '/cut'}")
        self.cut = table.process(name, prefix)
        self._damages = list[Fault]()

    def damage(self, fault: Fault) -> None:
        """Break the tool, or insert a hard spot into the material."""
        self._damages.append(fault)
        self._suffer()

    def mend(self, fault: Fault | None) -> bool:
        """Repair a broken edge or remove a hard spot; None installs a new tool in uniform material."""
        mended = self._damages[:] if fault is None else [damage for damage in self._damages if damage == fault][:1]
        for damage in mended:
            self._damages.remove(damage)
        self._suffer()
        return bool(mended)

    def _suffer(self) -> None:
        shorter = sum(fault.values["length"] for fault in self._damages if fault.kind == "tool_broken")
        spots = [
            HardSpot(fault.values["start"], fault.values["width"], -np.inf, np.inf, fault.values["factor"])
            for fault in self._damages
            if fault.kind == "hard_spot"
        ]
        self.cut.damage(shorter=shorter, spots=spots)

    @property
    def streams(self) -> list[NormalStream]:
        """Return the random streams of the drives' sensors, the allowance and the force sensor."""
        return [*super().streams, self._allowance.stream, self._force_sensor.stream]

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """End a run whose cut cannot continue.

        Raises:
            LatheError: the cut cannot continue.
        """
        encoder, cut = inputs[0], outputs[-1]
        raise self.failure(reason, encoder["angle_true"][reached], encoder["speed_true"][reached], cut["feed"][reached])


class CuttingProcessStage(CutStage):
    """Cutting process with rigid drives (see `lathe_machine.plants.cutting`)."""

    kind = "cutting_process"
    Parameters = CuttingProcessParameters
    parameters: CuttingProcessParameters
    rooms = 4
    step = staticmethod(step)

    def __init__(self, name: str, parameters: CuttingProcessParameters) -> None:
        super().__init__(name, parameters, parameters, "")
        self.declare(
            inputs=[TURNS, *(READ[name] for name in parameters.moved_by)],
            outputs=[Output("cut", messages.CUT)],
        )

    @property
    def memory(self) -> Memory:
        """Current state of the cutting process's step function."""
        parameters = self.parameters
        places, place = dict.fromkeys(READ, -1), 2
        for name in parameters.moved_by:
            places[name] = place
            place += len(READ[name].fields)
        return Memory(
            cut=self.cut.table,
            allowance=self._allowance.table,
            sensor=self._force_sensor.table,
            **places,
            even=parameters.blank == "form",
            feed=parameters.feed / (2.0 * np.pi),
            room=self.room,
        )
