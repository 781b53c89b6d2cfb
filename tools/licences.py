# SPDX-License-Identifier: Apache-2.0
"""Print docs/licences.md: the licences of all packages that ./lathe has installed, as these state them themselves."""

import json
import re
from collections import defaultdict
from collections.abc import Iterable
from importlib.metadata import Distribution, distributions
from pathlib import Path
from xml.etree import ElementTree as ET

from workplace import NODE, VENV

HEAD = """\
# Licences

This page lists the packages that `./lathe setup docs fmu formats notebook panel sweep test view` installs, by their
stated licence: Python packages in the versions of `requirements/python.lock` and `requirements/ros.lock`, then the npm
packages of the documentation site. The only copied source is [third_party/](../third_party/simulation_interfaces):
message definitions of simulation_interfaces 2.1.0, Apache-2.0. "Not stated": the package contains only the text
of its licence. `./lathe python tools/licences.py > docs/licences.md` writes this page.
"""
OURS = {"lathe_rc", "lathe_rc_msgs"}
LONGEST = 60  # characters; longer: the text of a licence


def main() -> None:
    """Print the page."""
    print(HEAD)
    print("## Python\n")
    installed = {found.name: found for found in distributions(path=[str(path) for path in site()])}
    doubles = {name for name in installed if f"ros-{name.replace('_', '-')}" in installed}
    names = [name for name in installed if name not in doubles and not name.startswith("ros-jazzy-")]  # other names
    table((licence(installed[name]), name) for name in names)
    print("\n## npm\n")
    lock = json.loads((NODE / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    lock.pop("")  # the list itself
    table(
        (said.get("license", "not stated"), path.rpartition("node_modules/")[2]) for path, said in lock.items() if path
    )


def site() -> list[Path]:
    """Return the folders of installed packages."""
    return sorted(VENV.glob("lib/python3.*/site-packages"))


def licence(found: Distribution) -> str:
    """Return the licence of a package: an SPDX expression, a classifier, a short text, or that of its package.xml."""
    said = found.metadata
    manifest = VENV / "share" / found.name.removeprefix("ros-").replace("-", "_") / "package.xml"
    lines = [line for line in said.get_all("Classifier") or [] if line.startswith("License")]
    classifiers = "; ".join(line.rpartition(" :: ")[2] for line in lines)
    texts = [said["License-Expression"] or "", classifiers, said["License"] or ""]
    if manifest.is_file():
        texts.append("; ".join(str(tag.text) for tag in ET.parse(manifest).iter("license")))  # noqa: S314 - an installed file
    return next((text for text in texts if text and text != "UNKNOWN" and len(text) < LONGEST), "not stated")


def table(rows: Iterable[tuple[str, str]]) -> None:
    """Print the packages of each licence."""
    packages = defaultdict(set)
    for name, package in rows:
        if package not in OURS:
            packages[re.sub(r"[|\s]+", " ", name)].add(package)
    print("| licence | packages |\n| --- | --- |")
    for name in sorted(packages, key=str.lower):
        print(f"| {name} | {', '.join(sorted(packages[name], key=str.lower))} |")


if __name__ == "__main__":
    main()
