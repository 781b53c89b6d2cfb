# SPDX-License-Identifier: Apache-2.0
"""A stage of a scenario as a component of LinuxCNC: its C library of one sample a call, between pins of HAL."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lathe_export.c_library.library import Library, Signal
from lathe_export.c_library.sources import Exported, context, described, export_nodes, ranged
from lathe_export.c_library.templates import TEMPLATES
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError

_LONGEST = 47  # HAL_NAME_LEN of hal.h: characters of a name
_OWN = ("enable", "reset", "fault", "reason", "time", "tmax")  # pins of each component; the last two are of HAL


class Pin(NamedTuple):
    """Pin of a component, for an input, output or parameter of the library.

    Attributes:
        name: words with dashes, without the name of the component.
        type: ``float``, ``bit`` or ``u32``.
        doc: unit, range and delay.
    """

    name: str
    type: str
    doc: str

    @property
    def c(self) -> str:
        """Name in the code of the component."""
        return self.name.replace("-", "_")


def export_hal(
    scenario: Scenario,
    node: str,
    place: Path | None = None,
    *,
    name: str | None = None,
    tune: Sequence[str] = (),
    samples: int = 65536,
) -> Exported:
    """Write a stage of a scenario as a component for ``halcompile``, beside its C library, into a new folder.

    Args:
        scenario: the scenario.
        node: name of the stage.
        place: folder to make; None: the name with ``-hal``, in the current folder.
        name: name of the component; None: that of the stage.
        tune: see `lathe_export.c_library.library.Library`.
        samples: length of the reference of the library's example [sample].

    Raises:
        InputError: the name of a pin is too long or taken, or as for `lathe_export.c_library.sources.export_nodes`.
        LatheError: as for `lathe_export.c_library.sources.export_nodes`.
    """
    place = place or Path(f"{name or node}-hal")
    return export_nodes(scenario, [node], place, name=name, block=1, tune=tune, samples=samples, further=files)


def files(library: Library, scenario: str) -> dict[str, str]:
    """Return the files of a component beside those of its library by name: pins and function, and a Makefile.

    Args:
        library: the stage alone, of one sample a call.
        scenario: name of the scenario, for the comments.

    Raises:
        InputError: the name of a pin is too long or taken.
    """
    given, got = (
        [Pin(_words(each.name), _type(each), _doc(described(each).partition(" ")[2])) for each in signals]
        for signals in (library.inputs, library.outputs)
    )
    tuned = [
        Pin(_words(each.name.partition(".")[2]), "bit" if each.whole else "float", _doc(ranged(each)))
        for each in library.parameters
    ]
    taken = [*_OWN]
    for pin in (*given, *got, *tuned):
        name = f"{_words(library.name)}.{pin.name}"
        if len(name) > _LONGEST:
            raise InputError(f"pin {name}: {len(name)} characters; allowed: {_LONGEST}, by a shorter --name")
        if pin.name in taken:
            raise InputError(f"pin {name}: the name of another pin as well; allowed: another topic, by remap")
        taken.append(pin.name)
    made = context(library, scenario) | {"given": given, "got": got, "tuned": tuned}
    templates = TEMPLATES.overlay(trim_blocks=True)
    names = {f"{library.name}.comp": "NAME.comp", "Makefile": "Makefile"}
    return {name: templates.get_template(f"hal/{template}.j2").render(made) for name, template in names.items()}


def _words(name: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in name)


def _type(signal: Signal) -> str:
    return "float" if signal.bytes > 1 else "bit" if signal.high == 1.0 else "u32"


def _doc(text: str) -> str:
    """Return a text for a string of halcompile, which knows no escaped quotes."""
    return text.replace('"', "'")
