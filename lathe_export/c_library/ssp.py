# SPDX-License-Identifier: Apache-2.0
"""A whole cell as FMUs, one for each stage, with their connections: System Structure and Parameterization (SSP 1.0).

The components follow one another in the order of the cell: a master that steps them in this order, each with the newest
outputs of all others, has the bits of the engine.
"""

import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from lathe_export.c_library import fmu, sources
from lathe_export.c_library.library import Library
from lathe_rc import __version__
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

_SSP = "http://ssp-standard.org/SSP1/SystemStructure"
ET.register_namespace("ssd", f"{_SSP}Description")
ET.register_namespace("ssc", f"{_SSP}Common")


def export_ssp(scenario: Scenario, place: Path | None = None) -> tuple[Path, dict[str, Library]]:
    """Write the stages of a scenario as FMUs (FMI 2.0), and their connections.

    Args:
        scenario: the scenario.
        place: file to make; None: the name of the scenario with ``.ssp``, in the current folder.

    Returns:
        The file, and the stages as libraries by their names.

    Raises:
        InputError: as for `lathe_export.c_library.fmu.export_fmu`.
        LatheError: likewise.
    """
    place = place or Path(f"{scenario.name}.ssp")
    sources.check_new(place, "file")
    try:
        with tempfile.TemporaryDirectory(dir=place.absolute().parent) as folder:
            made = {
                name: fmu.export_fmu(scenario, [name], Path(folder) / name, fmi=2)
                for name in Cell(scenario.nodes).stages
            }
            libraries = {name: library for name, (_, library) in made.items()}
            archive = Path(folder) / "archive"
            with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
                file.writestr("SystemStructure.ssd", fmu.xml_text(_description(scenario.name, libraries)))
                for name, (path, _) in made.items():
                    file.write(path, f"resources/{name}.fmu", zipfile.ZIP_STORED)
            archive.rename(place)
    except OSError as error:
        raise LatheError(f"{place}: cannot be written ({error.strerror})") from None
    return place, libraries


def connections(libraries: Mapping[str, Library]) -> list[tuple[str, str, str]]:
    """Return the connections of stages: source, reader, and name of the signal."""
    source = {signal.name: node for node, library in libraries.items() for signal in library.outputs}
    read = [(node, signal.name) for node, library in libraries.items() for signal in library.inputs]
    return [(source[name], node, name) for node, name in read if name in source]


def _description(name: str, libraries: Mapping[str, Library]) -> ET.Element:
    root = _child(
        None, "SystemStructureDescription", name=name, version="1.0", generationTool=f"lathe_rc {__version__}"
    )
    system = _child(root, "System", name=name)
    elements = _child(system, "Elements")
    for node, library in libraries.items():
        kind = "application/x-fmu-sharedlibrary"
        listed = _child(
            _child(elements, "Component", name=node, source=f"resources/{node}.fmu", type=kind), "Connectors"
        )
        for signals, causality in ((library.inputs, "input"), (library.outputs, "output")):
            for signal in signals:
                connector = _child(listed, "Connector", name=signal.name, kind=causality)
                ET.SubElement(connector, f"{{{_SSP}Common}}{'Real' if signal.bytes == 8 else 'Integer'}")
    joined = _child(system, "Connections")
    for source, reader, shared in connections(libraries):
        ends = {"startElement": source, "startConnector": shared, "endElement": reader, "endConnector": shared}
        _child(joined, "Connection", **ends)
    _child(root, "DefaultExperiment", startTime="0")
    return root


def _child(parent: ET.Element | None, tag: str, **about: str) -> ET.Element:
    name = f"{{{_SSP}Description}}{tag}"
    return ET.Element(name, about) if parent is None else ET.SubElement(parent, name, about)
