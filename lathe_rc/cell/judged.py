# SPDX-License-Identifier: Apache-2.0
"""Declaration of a node by what a run is judged; recorders write it into the bag, where programs read it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from annotated_types import Ge
from pydantic import ConfigDict, TypeAdapter, ValidationError

from lathe_rc.errors import InputError
from lathe_rc.signals.zones import Zone


@dataclass(frozen=True)
class Judged:
    """Error by which a run is judged.

    Attributes:
        topic: relative topic of the messages with the error.
        quantity: quantity that is in error: the form of the part, or what a loop controls.
        step: sampling step [s].
        tolerance: allowed error to each side [m] or [N]; 0: not judged.
        nose_radius: nose radius of the tool in the plane of the feed [m]; 0: no surface along the part.
        delay: age of the measurement in the error of a loop [sample].
        limit: command of a loop from which on it is saturated.
        zones: parts of the surface with tolerances of their own.
    """

    __pydantic_config__: ClassVar = ConfigDict(allow_inf_nan=False, extra="forbid")

    topic: str
    quantity: Literal["form", "force", "position"]
    step: Annotated[float, Ge(0)]
    tolerance: Annotated[float, Ge(0)] = 0.0
    nose_radius: Annotated[float, Ge(0)] = 0.0
    delay: Annotated[int, Ge(0)] = 0
    limit: Annotated[float, Ge(0)] = 0.0
    zones: tuple[Zone, ...] = ()

    @property
    def tolerances(self) -> list[float]:
        """Tolerance outside of the zones, then those of the zones; 0: not judged."""
        return [self.tolerance, *(zone.tolerance for zone in self.zones)]


_BY_NODE = TypeAdapter(dict[str, Judged])


def to_text(found: Mapping[str, Judged]) -> str:
    """Return declarations by node as JSON."""
    return _BY_NODE.dump_json(dict(found)).decode()


def from_text(text: str, what: str) -> dict[str, Judged]:
    """Return the declarations by node that `to_text` wrote.

    Args:
        text: the JSON text.
        what: origin of the text, for messages.

    Raises:
        InputError: the text is no such declaration.
    """
    try:
        return _BY_NODE.validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{what}: {where or 'text'}: {first['msg']}") from None
