# SPDX-License-Identifier: Apache-2.0
"""Functional Mock-up Units of other tools, for co-simulation, read and loaded by FMPy.

An FMU is machine code: it runs with all rights of the process.
"""

import ctypes
import gc
import hashlib
import os
import shutil
import tempfile
import threading
import time
import weakref
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from lathe_machine.fmi.units import BASE, Powers, powers
from lathe_rc import extras
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.files import contents
from lathe_rc.jit import cache_folder
from lathe_rc.names import instead

with extras.named():
    import fmpy
    from fmpy import model_description, simulation

_MOST = 2**29  # longest FMU [B]
_UNPACKED, _RATIO = 2**26, 20  # size of what is unpacked [B], and relative to the FMU, of which the larger is allowed
_CACHE, _IN_USE = 2**30, 3600.0  # size of all unpacked FMUs [B] beyond those used so recently [s]
_ERROR = 2  # a status from which a call has failed: discard, error, fatal
_loading = threading.Lock()  # FMPy changes the current folder while it loads a library


class Unit(NamedTuple):
    """Unit of a variable: a value in SI units is ``factor * value + offset``.

    Attributes:
        name: name in the FMU; empty if the variable has none.
        factor, offset: see above.
        powers: powers of the SI base units; None if the variable has no unit.
    """

    name: str
    factor: float
    offset: float
    powers: Powers | None


_NO_UNIT = Unit("", 1.0, 0.0, None)


@dataclass(frozen=True, eq=False)
class Variable:
    """Variable of an FMU.

    Attributes:
        name: name in the FMU.
        reference: value reference.
        causality: such as ``input``, ``output`` or ``parameter``.
        is_real: whether it is one float64 number.
        settable: whether it may be set before the initialisation.
        unit: unit of a number.
    """

    name: str
    reference: int
    causality: str
    is_real: bool
    settable: bool
    unit: Unit


class Fmu:
    """FMU for co-simulation, read but not loaded.

    Args:
        path: path of the file.

    Attributes:
        path: see above.
        is_3: whether it implements FMI 3.0; otherwise FMI 2.0.
        variables: variables by name.
        model: FMPy's description of the model.

    Raises:
        InputError: the file is no FMU for co-simulation, or not for this platform.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.model: Any = self._read()
        self.is_3 = str(self.model.fmiVersion).startswith("3.")
        self._kind = self.model.coSimulation
        if self.model.fmiVersion == "1.0":
            raise InputError(f"{path}: an FMU of FMI 1.0; allowed: FMI 2.0 or 3.0")
        if self._kind is None:
            raise InputError(f"{path}: an FMU that is not for co-simulation; allowed: one that has its own solver")
        self._check_platform()
        known = {unit.name: unit for unit in self.model.unitDefinitions}
        self.variables = {each.name: self._variable(each, known) for each in self.model.modelVariables}

    def _read(self) -> Any:
        try:
            return model_description.read_model_description(self.path)
        except (OSError, zipfile.BadZipFile, KeyError) as error:
            told = getattr(error, "strerror", None) or str(error)
            raise InputError(f"{self.path}: no FMU ({shown(told)}); allowed: a ZIP archive as FMI defines it") from None
        except Exception as error:  # noqa: BLE001 - FMPy raises what its parsers do
            problems = getattr(error, "problems", [error])
            raise InputError(f"{self.path}: invalid modelDescription.xml: {shown(problems[0])}") from None

    def _check_platform(self) -> None:
        folder = fmpy.platform_tuple if self.is_3 else fmpy.platform
        wanted = f"binaries/{folder}/{self._kind.modelIdentifier}{fmpy.sharedLibraryExtension}"
        with zipfile.ZipFile(self.path) as archive:
            names = archive.namelist()
        if wanted not in names:
            has = sorted({name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") > 1})
            sources = any(name.startswith("sources/") for name in names)
            remedy = " (fmpy compile FILE builds one from the sources in it)" if sources else ""
            raise InputError(
                f"{self.path}: binaries for {', '.join(map(shown, has)) or 'no platform'}; allowed: an FMU with "
                f"{wanted}{remedy}"
            )

    def _variable(self, told: Any, known: Mapping[str, Any]) -> Variable:
        is_real = told.type in ("Real", "Float64") and not told.shape
        name = told.unit or (told.declaredType.unit if told.declaredType else None) or ""
        unit = self._unit(name, known) if is_real and name else _NO_UNIT
        settable = bool(simulation.settable_in_instantiated(told)) and told.causality != "structuralParameter"
        return Variable(told.name, told.valueReference, told.causality or "local", is_real, settable, unit)

    @staticmethod
    def _unit(name: str, known: Mapping[str, Any]) -> Unit:
        base = known[name].baseUnit if name in known else None
        if base is None:
            # Without a definition, a unit means what its name says, or nothing that can be converted.
            return Unit(name, 1.0, 0.0, powers(name))
        found = {each: int(power) for each in BASE if (power := getattr(base, each))}
        return Unit(name, float(base.factor), float(base.offset), MappingProxyType(found))

    def variable(self, name: str, *causalities: str) -> Variable:
        """Return a variable that is one float64 number.

        Raises:
            InputError: there is none with this name and one of the causalities, or it is no such number.
        """
        found = self.variables.get(name)
        allowed = [each for each, known in self.variables.items() if known.causality in causalities and known.is_real]
        if found is None or found.causality not in causalities:
            what = f"has the causality {found.causality}" if found else "is unknown"
            raise InputError(f"variable {shown(name)!r} of {self.path.name} {what}; {instead(name, allowed)}")
        if not found.is_real:
            raise InputError(
                f"variable {shown(name)!r} of {self.path.name} is no float64 number; {instead('', allowed)}"
            )
        if found.unit.name and found.unit.powers is None:
            raise InputError(
                f"variable {shown(name)!r} of {self.path.name} is in {shown(found.unit.name)}, which the FMU does not "
                "define; allowed: a BaseUnit in its UnitDefinitions"
            )
        return found

    @property
    def usual_step(self) -> float | None:
        """Step [s] that the FMU is made for, if it tells one."""
        experiment = self.model.defaultExperiment
        told = self._kind.fixedInternalStepSize or (experiment.stepSize if experiment else None)
        return float(told) if told else None

    def check_step(self, step: float) -> None:
        """Check a communication step [s] against the FMU's own.

        Raises:
            InputError: the FMU computes in longer steps, or in steps that do not divide this one.
        """
        own = float(self._kind.fixedInternalStepSize or 0.0)
        if own and (step < own or abs(round(step / own) * own - step) > 1e-9 * own):
            raise InputError(
                f"a step of {step:.9g} s: {self.path.name} computes in steps of {own:.9g} s; allowed: a multiple"
            )

    @property
    def has_state(self) -> bool:
        """Whether an instance can save its state as bytes."""
        return bool(self._kind.canGetAndSetFMUstate and self._kind.canSerializeFMUstate)

    @property
    def is_single(self) -> bool:
        """Whether a process may have one instance only."""
        return bool(self._kind.canBeInstantiatedOnlyOncePerProcess)

    def is_taken(self) -> bool:
        """Return whether this process has an instance."""
        if any(other.fmu.path == self.path for other in _alive):
            gc.collect()  # that of a cell which has ended may still be there
        return any(other.fmu.path == self.path for other in _alive)

    def unpacked(self) -> Path:
        """Return the folder with the binary and resources of the FMU, which are unpacked once on this computer.

        Raises:
            InputError: they are too large.
            LatheError: they cannot be unpacked.
        """
        try:
            place = cache_folder().parent / "fmu" / hashlib.sha256(contents(self.path, _MOST)).hexdigest()
            if not place.is_dir():
                self._check_size()
                place.parent.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryDirectory(dir=place.parent) as folder:
                    fmpy.extract(self.path, Path(folder) / "content", self._is_needed)
                    with suppress(FileExistsError):
                        (Path(folder) / "content").rename(place)
                _make_room(place)
            with suppress(OSError):  # of a cache that is only read
                os.utime(place)
        except LatheError:
            raise
        except Exception as error:  # noqa: BLE001 - FMPy and zipfile raise what they like about a damaged archive
            raise LatheError(f"{self.path}: cannot be unpacked ({shown(error)})") from None
        return place

    def _is_needed(self, name: str) -> bool:
        """Return whether an instance needs a file of the FMU: neither its sources nor other platforms' binaries."""
        folder = fmpy.platform_tuple if self.is_3 else fmpy.platform
        return name == "modelDescription.xml" or name.startswith((f"binaries/{folder}/", "resources/"))

    def _check_size(self) -> None:
        with zipfile.ZipFile(self.path) as archive:
            size = sum(each.file_size for each in archive.infolist() if self._is_needed(each.filename))
        allowed = max(_UNPACKED, _RATIO * self.path.stat().st_size)
        if size > allowed:
            raise InputError(
                f"{self.path}: its binary and resources unpack to {size / 2**20:.0f} MiB; allowed: "
                f"{allowed / 2**20:.0f} MiB, or {_RATIO} times the FMU (store large resources uncompressed, or outside)"
            )


def _make_room(newest: Path) -> None:
    """Remove the FMUs used longest ago from the cache while it is too large; those of the last hour may be in use."""
    known = [(each.stat().st_mtime, each) for each in newest.parent.iterdir() if each.is_dir()]
    total = 0
    for used, place in sorted(known, reverse=True):
        total += sum(each.stat().st_size for each in place.rglob("*") if each.is_file())
        if total > _CACHE and used < time.time() - _IN_USE:
            shutil.rmtree(place, ignore_errors=True)


@cache
def _known(path: str, size: int, changed: int) -> Fmu:  # noqa: ARG001 - the key
    return Fmu(Path(path))


def read(path: str) -> Fmu:
    """Return the FMU in a file, which is read once as long as it does not change.

    Raises:
        InputError: see `Fmu`.
    """
    try:
        about = Path(path).stat()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; allowed: an FMU") from None
    return _known(path, about.st_size, about.st_mtime_ns)


_alive: "weakref.WeakSet[Instance]" = weakref.WeakSet()


class Instance:
    """Running instance of an FMU, from time 0.

    Args:
        fmu: the FMU.
        values: values that are set before the initialisation, by variable, numbers in the variable's own unit.

    Attributes:
        fmu: see above.
        component: address of the instance.

    Raises:
        InputError: a value cannot be set.
        LatheError: the FMU fails, or allows one instance in a process, and there is one.
    """

    def __init__(self, fmu: Fmu, values: Mapping[str, object]) -> None:
        self.fmu, self._said = fmu, list[str]()
        if fmu.is_single and fmu.is_taken():
            raise LatheError(
                f"{fmu.path}: a process may have one instance of it, and has one; allowed: nodes in processes of their "
                "own, or one node with it"
            )
        with self.explained("the instantiation"), _loading:
            self._fmu: Any = simulation.instantiate_fmu(
                str(fmu.unpacked()), fmu.model, "CoSimulation", logger=_listener(self._said)
            )
        self.component = int(self._fmu.component)
        _alive.add(self)
        weakref.finalize(self, _free, self._fmu, os.getpid())
        with self.explained("the initialisation"):
            self._listen()
            for variable, value in values.items():
                self._set(variable, value)
            if fmu.is_3:
                self._fmu.enterInitializationMode(startTime=0.0)
            else:
                self._fmu.setupExperiment(startTime=0.0)
                self._fmu.enterInitializationMode()
            self._fmu.exitInitializationMode()

    def _listen(self) -> None:
        """Ask the FMU to log failures, and nothing else."""
        wanted = [each.name for each in self.fmu.model.logCategories if "error" in each.name.lower()]
        if wanted:
            self._fmu.setDebugLogging(loggingOn=True, categories=wanted)

    def _set(self, variable: str, value: object) -> None:
        try:
            simulation.apply_start_values(self._fmu, self.fmu.model, {variable: value})
        except ValueError:
            raise InputError(f"{shown(variable)} = {shown(value)}: no value of this variable's type") from None

    @contextmanager
    def explained(self, what: str) -> Iterator[None]:
        """Convert FMPy's exceptions into one line with what the FMU has logged."""
        try:
            yield
        except LatheError:
            raise
        except Exception as error:  # noqa: BLE001 - FMPy raises Exception
            raise LatheError(f"{self.fmu.path.name}: {what} failed: {self.failure(error)}") from None

    def failure(self, error: object = "") -> str:
        """Return the newest failure that the FMU has logged; ``error`` if there is none."""
        return self._said[-1] if self._said else shown(error)

    def numbers(self, variables: Sequence[Variable]) -> list[float]:
        """Return the values of variables in their units."""
        references = [each.reference for each in variables]
        with self.explained("reading the outputs"):
            read = self._fmu.getFloat64 if self.fmu.is_3 else self._fmu.getReal
            return list(read(references)) if references else []

    def address(self, function: str) -> int:
        """Return the address of a C function of the FMU; ``function`` is its name without ``fmi2`` or ``fmi3``."""
        found = getattr(self._fmu.dll, f"fmi{3 if self.fmu.is_3 else 2}{function}")
        return int(ctypes.cast(found, ctypes.c_void_p).value or 0)

    def state(self) -> bytes:
        """Return the state of the instance.

        Raises:
            LatheError: the FMU cannot tell it.
        """
        self._check_state()
        with self.explained("saving the state"):
            state = self._fmu.getFMUState()
            try:
                return bytes(self._fmu.serializeFMUState(state))
            finally:
                self._fmu.freeFMUState(state)

    def restore(self, told: bytes) -> None:
        """Set the state of the instance to one that `state` has returned.

        Raises:
            LatheError: the FMU cannot, or it is no state of this FMU.
        """
        self._check_state()
        with self.explained("setting the state"):
            state = self._fmu.deserializeFMUState(told)
            self._fmu.setFMUState(state)
            self._fmu.freeFMUState(state)

    def _check_state(self) -> None:
        if not self.fmu.has_state:
            raise LatheError(
                f"{self.fmu.path}: the FMU cannot save its state (canSerializeFMUState is false); allowed: runs from "
                "sample 0 on"
            )


def _listener(said: list[str]) -> Callable[..., None]:
    """Return a callback that collects what an FMU logs about failures."""

    def hear(*told: Any) -> None:
        status, _, text = told[-3:]  # in FMI 2.0, the name of the instance precedes them
        if status >= _ERROR:
            said.append(shown(bytes(text or b"").decode("utf-8", "replace")))

    return hear


def _free(fmu: Any, process: int) -> None:
    """Free an instance; what a fork has copied belongs to the other process."""
    if os.getpid() == process:
        with suppress(Exception):
            fmu.terminate()
        with suppress(Exception):
            fmu.freeInstance()
