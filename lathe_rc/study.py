# SPDX-License-Identifier: Apache-2.0
"""The interface of a study: parameters in, a result out that can be printed, drawn and written as JSON."""

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
    """Parameters of a study: a table as nodes have it, whose lists are never empty."""

    listing: ClassVar[str] = "lathe study {} --help"

    def model_post_init(self, context: Any, /) -> None:
        """Refuse empty lists: there would be nothing to compute."""
        for name, row in type(self).rows().items():
            if row.is_list and not getattr(self, name):
                raise InputError(f"{name} = []; allowed: at least one value, {row.allowed()}")


class Track(Protocol):
    """Passes items on and shows how many are done."""

    def __call__(self, items: Sequence[T], /) -> Iterable[T]:
        """The items, one by one."""


def untracked(items: Sequence[T], /) -> Iterable[T]:
    """Pass the items on and show nothing."""
    return items


class Result(Protocol):
    """The result of a study; a frozen dataclass."""

    def to_json(self) -> dict[str, Any]:
        """Everything in numbers, finite or None."""

    def table(self) -> "RenderableType":
        """The computed numbers beside those of the paper, at most 80 columns wide."""

    def draw(self, figure: "Figure") -> None:
        """Fill an empty figure."""


class Run(Protocol[P_contra]):
    """A study's function; pure: the same parameters give the same result."""

    def __call__(self, parameters: P_contra, track: Track = ...) -> Result:
        """Compute the study; its longest loop goes over ``track(items)``."""


@dataclass(frozen=True)
class Study(Generic[P]):
    """A table or figure of a paper, or a question that one raises, computed anew.

    Attributes:
        name: on the command line.
        doc: one line.
        parameters: its table.
        run: computes it.
        size: of its figure [in], width and height.
    """

    name: str
    doc: str
    parameters: type[P]
    run: Run[P]
    size: tuple[float, float] = (11.0, 3.8)


def comparison(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> RichTable:
    """A table in the style of all studies; the first column is text, the others are numbers."""
    table = RichTable(title=Text(title), title_justify="left", show_edge=False, header_style="bold")
    for number, column in enumerate(columns):
        table.add_column(Text(column), justify="right" if number else "left")
    for row in rows:
        # as Text: rich would take a unit in brackets for markup
        table.add_row(*(Text(cell) for cell in row))
    return table


#: by name: those of the papers, in `lathe_papers`, and those of other packages, by their entry points
STUDIES: Objects[Study[Any]] = Objects("study", Study, {}, "lathe_rc.studies")
