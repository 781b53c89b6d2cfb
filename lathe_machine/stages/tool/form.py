# SPDX-License-Identifier: Apache-2.0
"""Desired form of the part: parameters, table for the kernels, and the node that publishes the form alone."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le, Lt

from lathe_machine.signals.interpolation_doubt import Doubt, doubt
from lathe_machine.signals.measured_profile import Measured, doubts, read_csv
from lathe_machine.signals.part_profile import PartProfile, checked
from lathe_machine.signals.profile import Harmonics, Piston, Polygon, Profile
from lathe_machine.signals.profile_table import ProfileTable, deviation_along, height_along, tabulated
from lathe_machine.signals.tip_path import TipPath
from lathe_machine.stages.common.tables import made_of
from lathe_rc import messages, resources
from lathe_rc.analysis.tolerance import DOUBTED
from lathe_rc.arrays import put
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, Value, Values, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage
from lathe_rc.errors import InputError
from lathe_rc.extensions import Named, Registry, code_of_others
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples

_DOUBTED = 1e-3  # part of the form's height from which its doubt is told without a tolerance
_OWN = ("harmonics", "piston", "polygon", "csv")
#: third-party profiles, by name; built-in profiles have parameters of their own
PROFILES: Registry[PartProfile] = Registry("profile", PartProfile, {}, "lathe_rc.profiles")


class FormParameters(NodeParameters):
    """Desired form of the part and the feed along it."""

    profile: Annotated[str, Named(PROFILES, _OWN)] = parameter("harmonics", "kind of profile")
    profile_values: list[float] = parameter(
        [], "profile of others: numbers that it is made of, in the order of its constructor"
    )
    profile_file: str = parameter("", "csv: file with angle_deg, (height_mm,) radius_um", path=True)
    programmed_file: str = parameter(
        "",
        "CSV file of the programmed form, which the controllers follow, as lathe correct writes it; the form error is "
        "that of the form itself; empty: the form itself",
        path=True,
    )
    harmonic_order: list[Annotated[int, Ge(0), Le(2000)]] = parameter(
        [], "harmonics: waves per revolution; none at all: an oval of 225 µm (paper 000, Fig. 6)"
    )
    harmonic_amplitude: list[float] = parameter([], "harmonics: amplitudes", "m")
    harmonic_phase: list[float] = parameter([], "harmonics: phases at angle 0; empty: all 0", "rad")
    piston_ovality: NonNegative = parameter(0.5e-3, "piston: difference of the diameters at the ends of the skirt", "m")
    piston_ovality_middle: NonNegative = parameter(0.4e-3, "piston: the same at the widest place", "m")
    piston_barrel: NonNegative = parameter(30e-6, "piston: radius lost towards the ends", "m")
    piston_length: Positive = parameter(0.06, "piston: length of the skirt", "m")
    piston_widest: NonNegative = parameter(0.02, "piston: widest place from the start", "m")
    polygon_sides: Annotated[int, Ge(3), Le(64)] = parameter(3, "polygon: number of sides")
    polygon_inscribed_radius: Positive = parameter(1e-3, "polygon: radius of the inscribed circle", "m")
    polygon_corner_radius: Positive = parameter(0.8e-3, "polygon: radius of the corners", "m")
    height_from: Literal["feed", "slide"] = parameter(
        "feed", "what makes the height along the part: the feed below, or the longitudinal slide"
    )
    feed: NonNegative = parameter(0.0, "feed: advance along the part", "m/rev")
    start_height: NonNegative = parameter(0.0, "where along the part the run begins", "m")
    part_revolutions: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        0, "feed: after so many revolutions the next part begins at start_height; 0: one endless part", "rev"
    )
    part_radius: Positive = parameter(0.05, "radius that the form deviates from, for tip_radius and clearance", "m")
    tip_radius: NonNegative = parameter(
        0.0, "radius of the tool's tip in the plane across the spindle; 0: a point, which follows the form", "m"
    )
    tip_correction: bool = parameter(
        default=True,
        doc="the controllers are told the path that makes the tip turn the form; otherwise the form itself",
    )
    clearance: Annotated[float, Ge(0), Lt(1.5)] = parameter(
        0.0, "clearance angle of the tool; a form on which its flank would rub is refused; 0: not looked at", "rad"
    )

    def known(self) -> Mapping[str, Value]:
        """Form of the part, for laws with feed-forward."""
        return {name: getattr(self, name) for name in FORM}

    def causes_off(self, node: str, nodes: Mapping[str, NodeParameters], height: Samples) -> dict[str, Values]:
        """Return the cause ``feed``: the form changes along the part. Off: the tool stays at the middle height."""
        if self.part_revolutions or not np.ptp(height):
            return {}
        middle = max(float(height.min() + height.max()) / 2.0, 0.0)
        return {"feed": {"height_from": "feed", "feed": 0.0, "start_height": middle}}

    def form(self, node: str) -> Profile:
        """Return the profile of a node.

        Raises:
            InputError: lists differ in length, dimensions do not fit together, a file cannot be used, or a third-party
                profile is invalid.
        """
        if self.profile not in _OWN:
            make: Callable[..., PartProfile] = PROFILES[self.profile]
            with code_of_others(f"{node}.profile = {self.profile!r}"):
                made = make(*self.profile_values)
                checked(made)
                return made
        if self.profile == "csv":
            if not self.profile_file:
                raise InputError(f"{node}.profile_file is empty; name the CSV file of the profile")
            with about(node, "profile_file"):
                return read_csv(resources.find(Path(self.profile_file)))
        if self.profile == "piston":
            return made_of(Piston, self, "piston_")
        if self.profile == "polygon":
            with about(node, "polygon_corner_radius"):
                return made_of(Polygon, self, "polygon_")
        order, amplitude = self.harmonic_order, self.harmonic_amplitude
        if not order and not amplitude:
            order, amplitude = [2], [225e-6]
        phase = self.harmonic_phase or [0.0] * len(order)
        with about(node, "harmonic_order", "harmonic_amplitude", "harmonic_phase"):
            return Harmonics(np.array(order, dtype=float), np.array(amplitude), np.array(phase))

    def doubt(self, node: str, form: Profile) -> Doubt:
        """Return how far the form of a node may be off between the points or rows of its table.

        Raises:
            InputError: the code of a third-party profile fails.
        """
        with code_of_others(f"{node}.profile = {self.profile!r}"):
            return doubt(form)

    def form_doubt(self, node: str) -> float:
        """Return how far the form of the node may be off; 0 if another node has the form."""
        return self.doubt(node, self.form(node)).whole if self.known() else 0.0

    def programmed_form(self, node: str) -> Measured | None:
        """Return the programmed form of the controllers of a node; None: the form itself.

        Raises:
            InputError: the file cannot be used.
        """
        if not self.programmed_file:
            return None
        with about(node, "programmed_file"):
            return read_csv(resources.find(Path(self.programmed_file)))


FORM = frozenset(FormParameters.model_fields) - frozenset(NodeParameters.model_fields)  #: names of form parameters


class FormTable(NamedTuple):
    """Table of a `Form` for kernels.

    Attributes:
        heights, table: required tool position, see `lathe_machine.signals.profile_table.ProfileTable`.
        told: table of the tool position assumed by the controllers.
        alike: whether both tables are equal.
        slide: index of the first input of the longitudinal slide if the slide determines the height, otherwise 0.
        feed, start, part: height without a slide, see `lathe_machine.signals.profile_table.height_along`.
        told_heights: heights of the table of the controllers.
    """

    heights: Samples
    table: Samples
    told: Samples
    alike: bool
    slide: int
    feed: float
    start: float
    part: int
    told_heights: Samples


@kernel
def equal(one: Samples, other: Samples) -> bool:
    """Return whether two signals of shape (n,) are equal in every sample."""
    differs = False
    for k in range(one.size):
        differs |= one[k] != other[k]
    return not differs


@kernel
def _place(form: FormTable, angle: Samples, slide: Samples, height: Samples) -> None:
    """Fill the height [m] at an angle [rad] or at a position of the longitudinal slide [m]."""
    if form.slide:
        for k in range(height.size):
            height[k] = form.start + slide[k]
    else:
        height_along(form.feed, form.start, form.part, angle, height)


@kernel
def evaluate(
    form: FormTable, inputs: tuple[Samples, ...], reference: Samples, expected: Samples, height: Samples
) -> None:
    """Fill the desired displacement, the controllers' estimate of it, and the height [m], shape (n,) each.

    The first of ``inputs`` are those of the `Form`.
    """
    angle, angle_true = inputs[0], inputs[1]
    position, measured = angle_true, angle
    if form.slide:
        position, measured = inputs[form.slide], inputs[form.slide + 1]
    _place(form, angle_true, position, height)
    deviation_along(form.heights, form.table, angle_true, height, reference)
    # Equal angles give bit-identical results, so the form is evaluated only once for an ideal encoder.
    if form.alike and equal(angle, angle_true) and equal(position, measured):
        put(expected, reference)
    else:
        # The result array first contains the height, which is copied before the result is written.
        _place(form, angle, measured, expected)
        deviation_along(form.told_heights, form.told, angle, expected.copy(), expected)


def _tip_path(node: str, parameters: FormParameters, form: Profile) -> ProfileTable:
    """Return the table of the path on which a round tip turns a form."""
    with about(node, "tip_radius"):
        return tabulated(TipPath(form, parameters.part_radius, parameters.tip_radius))


class Form:
    """Tabulated form of a node.

    Args:
        node: name of the node.
        parameters: parameter table of the node.

    Attributes:
        surface: table of the form of the part.
        profile: table of the path that the controllers follow: the form, the path of a round tip, or that of the
            programmed form.
        inputs: input ports.
        table: table for `evaluate`.
        doubts: warnings about the files of the form, one line each.
        doubt: error of the interpolation of the form.

    Raises:
        InputError: as for `FormParameters.form`, or the tip does not fit the form, or a slide would have to restart.
    """

    def __init__(self, node: str, parameters: FormParameters) -> None:
        form, programmed = parameters.form(node), parameters.programmed_form(node)
        files = (
            ("profile_file", parameters.profile_file, form),
            ("programmed_file", parameters.programmed_file, programmed),
        )
        self.doubts = [
            f"{node}.{name} = {file}: {doubt}"
            for name, file, read in files
            if isinstance(read, Measured)
            for doubt in doubts(read)
        ]
        self.doubt = parameters.doubt(node, form)
        file = parameters.profile_file if parameters.profile == "csv" else ""
        self._named = f"profile_file = {file}" if file else f"profile = {parameters.profile}"
        self.surface = path = tabulated(form)
        self.profile = path if programmed is None else tabulated(programmed)
        if parameters.tip_radius:
            path = _tip_path(node, parameters, form)
            if parameters.tip_correction:
                self.profile = path if programmed is None else _tip_path(node, parameters, programmed)
        self.inputs = [Input("encoder", messages.ENCODER, ("angle", "angle_true"))]
        slides = parameters.height_from == "slide"
        self.table = FormTable(
            heights=path.heights,
            table=path.table,
            told=self.profile.table,
            alike=self.profile is path,
            slide=2 if slides else 0,
            feed=parameters.feed,
            start=parameters.start_height,
            part=parameters.part_revolutions,
            told_heights=self.profile.heights,
        )
        if slides:
            self.inputs.append(Input("longitudinal/state", messages.STATE, ("position", "measured_position")))
            if parameters.part_revolutions:
                raise InputError(f"{node}.part_revolutions with height_from = slide; allowed: 0, a slide does not jump")

    def warnings(self, node: str, tolerance: float) -> list[str]:
        """Return the warnings about the form of a node, one line each; ``tolerance``: of the form [m], 0 for none."""
        across, along = self.doubt
        told = []
        if np.isnan(across) or np.isnan(along):
            few = f"{self.surface.heights.size} heights" if np.isnan(along) else "so few angles"
            told.append(f"{few}: nothing shows how far the form between them is from what was meant")
        stroke = float(np.ptp(self.surface.table[..., 3]))
        if self.doubt.whole > (DOUBTED * tolerance or _DOUBTED * stroke):
            allowed = f" (tolerance: ±{tolerance * 1e6:.4g} µm)" if tolerance else ""
            parts = {"angles": across, "heights": along}
            off = [
                f"{each * 1e6:.3g} µm off between its {of}"
                for of, each in parts.items()
                if each > 0.01 * self.doubt.whole
            ]
            told.append(f"the form may be {' and '.join(off)}{allowed}: more of them help")
        return [*self.doubts, *(f"{node}.{self._named}: {text}" for text in told)]


@kernel
def step(memory: FormTable, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Evaluate the desired form and the height of one block."""
    reference, expected, height = outputs
    evaluate(memory, inputs, reference, expected, height)
    return height.size, DONE


class ProfileStage(Stage):
    """Stage that evaluates the form at the spindle angle and the height.

    Attributes:
        form: form of the part.
    """

    kind = "profile"
    Parameters = FormParameters
    parameters: FormParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: FormParameters) -> None:
        super().__init__(name, parameters)
        self.form = Form(name, parameters)
        self.declare(
            inputs=self.form.inputs,
            outputs=[Output("reference", messages.REFERENCE, Joint("reference"))],
        )

    def warnings(self, seconds: float) -> list[str]:
        """Return the warnings about the form, one line each."""
        return self.form.warnings(self.name, 0.0)

    @property
    def memory(self) -> FormTable:
        """Current state of the profile stage's step function."""
        return self.form.table
