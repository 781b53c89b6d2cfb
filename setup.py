# SPDX-License-Identifier: Apache-2.0
"""Package metadata; colcon, pip and the ament index all read it from here."""

import re
import runpy
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from setuptools import Distribution, find_packages, setup

# colcon's --symlink-install runs a link to this file from its build folder
HERE = Path(__file__).resolve().parent
# read, not imported: nothing that the package needs is there yet
CATALOGUE = runpy.run_path(str(HERE / "lathe_rc/catalogue.py"))
NODES = [*CATALOGUE["MACHINE"], "recorder"]
PACKAGES, ALONE = sorted(CATALOGUE["OURS"]), CATALOGUE["STANDALONE"]
PAPERS = sorted((HERE / "lathe_papers").glob("*.py"))
STUDIES = [path.stem for path in PAPERS if "\nSTUDY = " in path.read_text(encoding="utf-8")]
EXECUTABLES = {
    **{name: f"lathe_rc.nodes.executables:{name}" for name in (*NODES, *ALONE)},
    "launch_plan": "lathe_rc.harness.launch_plan:main",
}
#: colcon calls these commands, for which setup.cfg has the folder of the scripts
OF_COLCON = {"install", "develop"} & {*sys.argv}
#: an egg-info in the checkout would be found before the one of colcon, which has the executables
BUILT = {"bdist_wheel", "egg_info", "sdist"} & {*sys.argv}
# pip puts scripts on the PATH, where names like `tool` and `profile` do not belong. In lib/lathe_rc, where `ros2 run`
# finds them, pip writes no first line with the path of its Python: it is beside bin/ of the same environment.
SCRIPT = """#!/bin/sh
python="$(dirname "$(readlink -f "$0")")/../../bin/python3"
[ -x "$python" ] || python=python3
exec "$python" -c '
import sys
sys.argv[0], sys.path[:] = "{name}", filter(None, sys.path)  # not the current folder
from {module} import {function}
{function}()
' "$@"
"""


class InstallData(Distribution().get_command_class("install_data")):
    """Installation of the data files of a wheel, with the executables of ``ros2 run``."""

    def run(self) -> None:
        """Install the files, and write the executables."""
        super().run()
        folder = Path(self.install_dir) / "lib" / "lathe_rc"
        folder.mkdir(parents=True, exist_ok=True)
        for name, place in EXECUTABLES.items():
            module, _, function = place.partition(":")
            file = folder / name
            file.write_text(SCRIPT.format(module=module, function=function, name=name), encoding="utf-8")
            file.chmod(0o755)


def shared_files() -> list[tuple[str, list[str]]]:
    """Return what goes to share/: the ament index marker, the manifest, launch files and scenarios."""
    folders = defaultdict(list, {"share/ament_index/resource_index/packages": ["resource/lathe_rc"]})
    folders["share/lathe_rc"].append("package.xml")
    for path in sorted([*HERE.glob("launch/*.launch.py"), *HERE.glob("config/**/*.*"), *HERE.glob("urdf/*.urdf")]):
        relative = path.relative_to(HERE)
        folders[f"share/lathe_rc/{relative.parent}"].append(str(relative))
    return list(folders.items())


def requirements(name: str) -> list[str]:
    """Return the requirements in a list; the lock files are made from the same lists."""
    lines = (HERE / "requirements" / f"{name}.in").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


VERSION = re.search(r'__version__ = "(.+)"', (HERE / "lathe_rc" / "__init__.py").read_text(encoding="utf-8"))[1]

setup(
    name="lathe_rc",
    version=VERSION,
    description="The control cell of a non-circular lathe as ROS 2 nodes",
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    packages=find_packages(include=[each for name in PACKAGES for each in (name, f"{name}.*")]),
    # lathe_rc/msg_defs is a link to msg_defs: importlib.resources finds the messages in every installation
    package_data={
        "lathe_rc": [
            "py.typed",
            "__init__.pyi",
            "nodes/*.xml",
            "msg_defs/msg/*.msg",
            "msg_defs/srv/*.srv",
            "drawing/*.j2",
            "drawing/*.css",
            "drawing/*.js",
            "view/*.j2",
            "templates/*/*.j2",
        ],
        "lathe_bagtools": ["py.typed", "__init__.pyi"],
        "lathe_commission": ["py.typed", "__init__.pyi"],
        "lathe_explore": ["py.typed", "__init__.pyi", "sweep/*.j2"],
        "lathe_export": ["py.typed", "__init__.pyi", "templates/*/*.j2", "templates/*/*.h"],
        "lathe_machine": ["py.typed", "__init__.pyi"],
        "lathe_live": ["py.typed", "*.j2", "*.css", "*.html", "*.js"],
    },
    data_files=shared_files(),
    python_requires=">=3.10,<3.15",
    install_requires=requirements("runtime"),
    extras_require={
        # `colcon test` runs pytest if the extra `test` asks for it, and else no test at all
        **{name: requirements(name) for name in ("fmu", "formats", "notebook", "panel", "sweep", "test", "view")},
        # pip builds the messages from their sdist, see msg_defs/pyproject.toml
        "ros": [*requirements("ros"), f"lathe_rc_msgs=={VERSION}"],
    },
    entry_points={
        "console_scripts": [
            "lathe = lathe_rc.cli:main",
            *(f"{name} = {place}" for name, place in EXECUTABLES.items() if OF_COLCON),
        ],
        "lathe_rc.stages": ["adrc = lathe_papers.adrc:Adrc"],
        "lathe_rc.studies": [f"{study.replace('_', '-')} = lathe_papers.{study}:STUDY" for study in STUDIES],
    },
    options={"egg_info": {"egg_base": tempfile.mkdtemp()}} if BUILT else {},
    cmdclass={} if OF_COLCON else {"install_data": InstallData},
    zip_safe=False,
)
