# SPDX-License-Identifier: Apache-2.0
"""Interface of a study: parameters as input, and a result that can be printed, drawn and written as JSON."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

from rich.table import Table as RichTable
from rich.text import Text

from lathe_rc.cell.parameters import Table
from lathe_rc.errors import InputError
from lathe_rc.extensions import Objects

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import RenderableType

T = TypeVar("T")
P_contra = TypeVar("P_contra", bound="StudyParameters", contravariant=True)
P = TypeVar("P", bound="StudyParameters")


class StudyParameters(Table):
    """Parameters of a study: a parameter table like that of a node, in which lists must not be empty."""

    listing: ClassVar[str] = "lathe study {} --help"

    def model_post_init(self, context: Any, /) -> None:
        """Reject empty lists, with which the study would compute nothing."""
        for name, row in type(self).rows().items():
            if row.is_list and not getattr(self, name):
                raise InputError(f"{name} = []; allowed: at least one value, {row.allowed()}")


class Track(Protocol):
    """Progress display for a loop: yields the items and shows how many are finished."""

    def __call__(self, items: Sequence[T], /) -> Iterable[T]:
        """Yield the items one by one."""


def untracked(items: Sequence[T], /) -> Iterable[T]:
    """Yield the items without a progress display."""
    return items


class StudyResult(Protocol):
    """Result of a study; a frozen dataclass."""

    def to_json(self) -> dict[str, Any]:
        """Return all numbers of the result for JSON, each finite or None."""

    def table(self) -> "RenderableType":
        """Return a table of the computed numbers next to those of the paper, at most 80 columns wide."""

    def draw(self, figure: "Figure") -> None:
        """Draw the result into an empty figure."""


class Computation(Protocol[P_contra]):
    """Function that computes a study; it is pure: equal parameters give equal results."""

    def __call__(self, parameters: P_contra, track: Track = ...) -> StudyResult:
        """Compute the study; its longest loop iterates over ``track(items)``."""


@dataclass(frozen=True)
class Study(Generic[P]):
    """Reproduction of a table or figure of a paper, or investigation of a question that a paper raises.

    Attributes:
        name: name on the command line.
        doc: one-line summary.
        parameters: class of the parameters.
        run: function that computes the study.
        size: width and height of the figure [in].
    """

    name: str
    doc: str
    parameters: type[P]
    run: Computation[P]
    size: tuple[float, float] = (11.0, 3.8)


def comparison(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> RichTable:
    """Return a table in the common style of the studies; the first column contains text, the others numbers."""
    table = RichTable(title=Text(title), title_justify="left", show_edge=False, header_style="bold")
    for number, column in enumerate(columns):
        table.add_column(Text(column), justify="right" if number else "left")
    for row in rows:
        # as Text: rich would interpret a unit in brackets as markup
        table.add_row(*(Text(cell) for cell in row))
    return table


#: studies by name: those of the papers, from `lathe_papers`, and those that other packages offer as entry points
STUDIES: Objects[Study[Any]] = Objects("study", Study, {}, "lathe_rc.studies")
