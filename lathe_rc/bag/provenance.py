# SPDX-License-Identifier: Apache-2.0
"""Provenance of a run: scenario, files and versions, stored in the bag so that the run can be reproduced later."""

import base64
import contextlib
import json
import math
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from lathe_rc import __version__, allowed_code, resources
from lathe_rc.cell import ros_yaml
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.judged import Judged, from_text, to_text
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.parameters import NodeParameters, Value, form_doubt
from lathe_rc.cell.parameters import judged as judged_of
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import Scenario, kind_of
from lathe_rc.cell.time_master import START_FROM
from lathe_rc.errors import InputError, shown
from lathe_rc.files import contents

SCENARIO, NAME, VERSIONS = "lathe_rc.scenario", "lathe_rc.name", "lathe_rc.versions"
RUN_ID, HOST_TOPICS = "lathe_rc.run_id", "lathe_rc.host_topics"
FILE = "lathe_rc.file."  #: key prefix before NODE.PARAM; the value is the content of the file that the parameter names
ORIGINS = "lathe_rc.origins"  #: origins of third-party classes, if there are any
RECOVERED = "lathe_rc.recovered"  #: recovery report, including the losses
COPIED = "lathe_rc.copied"  #: number of messages copied from each source bag
FORM_DOUBT = "lathe_rc.form_doubt"  #: how far the form may be off between the points of its table [m], if at all
JUDGED = "lathe_rc.judged"  #: errors by which a run is judged, by node (`lathe_rc.cell.judged`)
_LEAST_DOUBT = 1e-8  # [m] of a form; no lathe turns a smaller one
_MOST_FILE = 2**19  # longest file that is stored [B]
_CODE = re.compile(r"[\w.]+:[\w.]+")  # package.module:Class
_HASH = 12  # number of characters displayed of a hash
_MOST_ORIGINS = 256
_PACKAGES = ("numpy", "scipy", "numba", "mcap", "rosbags")


def tell(scenario: Scenario, host_topics: Sequence[str]) -> dict[str, str]:
    """Return the provenance of a run as strings for a bag's metadata.

    Args:
        scenario: scenario with the actual parameters of the nodes.
        host_topics: topics recorded in addition to the signals.
    """
    nodes: dict[str, NodeParameters] = {}
    files: dict[str, str] = {}
    for name, table in scenario.nodes.items():
        if isinstance(table, RecorderParameters):
            continue
        nodes[name] = table
        for row in type(table).rows().values():
            # A file that does not exist yet or is too long is left out.
            with contextlib.suppress(OSError):
                if row.is_path and row.name not in allowed_code.FILES:
                    kept = contents(resources.find(Path(str(getattr(table, row.name)))), _MOST_FILE)
                    files[f"{FILE}{name}.{row.name}"] = base64.b64encode(kept).decode()
    return {
        RUN_ID: scenario.shared.run_id,
        NAME: scenario.name,
        HOST_TOPICS: json.dumps(list(host_topics)),
        VERSIONS: json.dumps(_versions()),
        SCENARIO: Scenario(scenario.name, nodes).to_yaml(),
        JUDGED: to_text(judged_of(nodes)),
        **({FORM_DOUBT: f"{off:.3g}"} if (off := form_doubt(nodes)) > _LEAST_DOUBT else {}),
        **({ORIGINS: json.dumps(found)} if (found := origins_of(nodes)) else {}),
        **files,
    }


def origins_of(nodes: Mapping[str, NodeParameters]) -> dict[str, dict[str, object]]:
    """Return the origin of each third-party class (see `Registry.origin`), and the parameters that name the class."""
    named: list[tuple[str, Mapping[str, str] | None]] = []
    for node, table in nodes.items():
        kind = kind_of(node, table.stage)
        if kind in STAGES:
            named.append((f"{node}.stage", STAGES.origin(kind)))
        for name, row in type(table).rows().items():
            if row.named is not None:
                others = row.named.others(getattr(table, name))
                named += [(f"{node}.{name}", row.named.registry.origin(each)) for each in dict.fromkeys(others)]
    used: dict[str, list[str]] = {}
    found: dict[str, dict[str, object]] = {}
    for parameter, origin in named:
        if origin is not None:
            own = used.setdefault(origin["class"], [])
            own.append(parameter)
            found[origin["class"]] = {key: text for key, text in origin.items() if key != "class"} | {"used": own}
    return found


@dataclass(frozen=True)
class Origin:
    """Provenance of a third-party class at the time when a bag was made.

    Attributes:
        name: name of the class, as ``package.module:Class``.
        distribution, version: distribution package and its version; empty if the class did not come from one.
        source: hash of the source code.
        used: parameters that refer to the class, as NODE.PARAM.
    """

    name: str
    distribution: str
    version: str
    source: str
    used: tuple[str, ...]

    @property
    def package(self) -> str:
        """Distribution and version; empty if the class was not installed with a distribution package."""
        return f"{self.distribution} {self.version}".strip()


def origins(about: Mapping[str, str]) -> list[Origin]:
    """Return the origins of the third-party classes of a bag; empty if there are none or the entry is damaged."""
    found: list[Origin] = []
    try:
        for name, said in list(json.loads(about.get(ORIGINS, "{}")).items())[:_MOST_ORIGINS]:
            texts = [str(said.get(key, "")) for key in ("distribution", "version", "source")]
            distribution, version, source = (shown(text) if text else "" for text in texts)
            used = tuple(shown(each) for each in said["used"][:_MOST_ORIGINS])
            found.append(Origin(shown(name), distribution, version, source, used))
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
        return []
    return found


def _check_installed(about: Mapping[str, str]) -> None:
    """Reject a bag whose third-party classes are not installed, without importing anything.

    Raises:
        InputError: a class is not installed; the message states what to install.
    """
    for origin in origins(about):
        package = origin.name.partition(":")[0].partition(".")[0]
        if package not in sys.modules and (not package.isidentifier() or find_spec(package) is None):
            raise InputError(
                f"{', '.join(origin.used)}: the bag was made with {origin.name}, and there is no module {package}; "
                f"allowed: install {origin.package or package}, or {allowed_code.OPTION} {package} if it lies in the "
                "current folder"
            )


def changes(about: Mapping[str, str], scenario: Scenario) -> list[str]:
    """Return the changes of third-party classes since a bag was made, one line per class."""
    made, here = {origin.name: origin for origin in origins(about)}, origins_of(scenario.nodes)
    found = []
    for name, now in here.items():
        if (origin := made.get(name)) is None:
            continue
        version, source = str(now.get("version", "")), str(now["source"])
        if version != origin.version:
            what = f"version {version or 'none'} here, and {origin.version or 'none'} when the bag was made"
        elif source != origin.source:
            what = f"source {source[:_HASH]} here, and {origin.source[:_HASH]} when the bag was made"
        else:
            continue
        found.append(f"{name} has {what}")
    return found


def named_files(about: Mapping[str, str]) -> dict[str, str]:
    """Return the files, by NODE.PARAM, that a bag's scenario refers to but the bag does not contain.

    Raises:
        InputError: the bag's scenario is not a parameter file.
    """
    return {
        f"{node}.{key}": str(value)
        for node, values in values_of(about).items()
        for key, value in values.items()
        if (key.endswith("_file") or key == START_FROM) and value and f"{FILE}{node}.{key}" not in about
    }


def foreign(about: Mapping[str, str]) -> list[str]:
    """Return the third-party code and missing files of a bag's scenario, one line each; nothing is imported."""
    try:
        files = named_files(about)
    except InputError as error:
        return [str(error)]  # such a bag can be read, but not re-simulated
    code = [
        f"{node}.{key} names code, {shown(each)}"
        for node, values in values_of(about).items()
        for key, value in values.items()
        for each in (value if isinstance(value, list) else [value])
        if isinstance(each, str) and _CODE.fullmatch(each)
    ]
    lacking = [f"{key} names a file that the bag does not hold, {shown(path)}" for key, path in files.items()]
    return [*dict.fromkeys(code), *lacking]


def another(about: Mapping[str, str], key: str, said: str) -> dict[str, str]:
    """Return the entry of a bag that was made of another one, after what that bag says of its own origin."""
    return {key: "; before that: ".join([said, *([about[key]] if key in about else [])])}


def origin(about: Mapping[str, str]) -> list[str]:
    """Return the statements of a bag that was not recorded, but made of other bags."""
    words = {RECOVERED: "recovered", COPIED: "copied"}
    return [f"{word}: {shown(about[key], 2000)}" for key, word in words.items() if key in about]


def namespace(about: Mapping[str, str]) -> str:
    """Return the namespace of the cell as a topic prefix; empty if there is none or the bag does not state it."""
    try:
        topics = [str(topic)[:256] for topic in json.loads(about.get(HOST_TOPICS, "[]"))[:256]]
    except (ValueError, TypeError, RecursionError, KeyError):
        return ""
    return next((topic.removesuffix("/cell_state") for topic in topics if topic.endswith("/cell_state")), "")


def values_of(about: Mapping[str, str]) -> dict[str, dict[str, Value]]:
    """Return the unvalidated values of a bag's scenario by node and parameter; empty without a scenario.

    Raises:
        InputError: the bag's scenario is not a parameter file.
    """
    return ros_yaml.parse(about[SCENARIO], f"{SCENARIO} of the bag") if SCENARIO in about else {}


def judged(about: Mapping[str, str]) -> dict[str, Judged]:
    """Return by node the errors by which the run of a bag is judged; empty without a scenario.

    Raises:
        InputError: the bag has a scenario, but does not state what is judged, or states it wrongly.
    """
    if JUDGED not in about and SCENARIO in about:
        raise InputError(f"the bag has no {JUDGED}, as those of earlier versions; lathe resim makes one that has")
    return from_text(about[JUDGED], f"{JUDGED} of the bag") if JUDGED in about else {}


def doubt_of(about: Mapping[str, str]) -> float:
    """Return how far the form of a bag may be off between the points of its table [m]; infinite if damaged."""
    try:
        doubt = float(about.get(FORM_DOUBT, "0"))
    except ValueError:
        return math.inf
    return doubt if doubt >= 0.0 else math.inf


def _versions() -> dict[str, str]:
    found = {"lathe_rc": __version__, "python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def scenario_of(about: Mapping[str, str], folder: Path, overrides: Sequence[str] = ()) -> Scenario:
    """Return the scenario that a bag was made with.

    The scenario's files are written to ``folder``, which must exist as long as the scenario is in use. A bag's scenario
    is untrusted data: it may not refer to other files, nor to code that is not allowed (`lathe_rc.allowed_code`).

    Raises:
        InputError: the bag has no scenario, or one that is not allowed or not accepted by this version.
    """
    if SCENARIO not in about:
        raise InputError("the bag holds no scenario; it was not made by lathe_rc, or its recorder never saw the cell")
    _check_installed(about)
    file = folder / "scenario.yaml"
    file.write_bytes(about[SCENARIO].encode(errors="surrogatepass"))
    copies: dict[str, Path] = {}
    for key, text in about.items():
        parameter = key.removeprefix(FILE)
        if not key.startswith(FILE):
            continue
        copies[parameter] = folder / f"file{len(copies)}"
        try:
            copies[parameter].write_bytes(base64.b64decode(text))
        except ValueError:
            raise InputError(
                f"{key[:80]!r} of the bag is not base64; recover the bag, or set {parameter[:80]!r} anew"
            ) from None
    loaded = scenarios.load(file, overrides, complete=True, copies=copies)
    return Scenario(about.get(NAME, "") or loaded.name, loaded.nodes)
