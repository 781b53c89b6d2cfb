# SPDX-License-Identifier: Apache-2.0
"""Package metadata; colcon, pip and the ament index all read it from here."""

import re
from collections import defaultdict
from pathlib import Path

from setuptools import find_packages, setup

# colcon's --symlink-install runs a link to this file from its build folder
HERE = Path(__file__).resolve().parent
# read, not imported: nothing that the stages need is there yet
STAGES = re.findall(r'^    "(\w+)": "\w+:\w+",$', (HERE / "lathe_rc/cell/stages/__init__.py").read_text(), re.MULTILINE)
NODES = [*STAGES, "recorder"]
PAPERS = sorted((HERE / "lathe_papers").glob("*.py"))
STUDIES = [path.stem for path in PAPERS if "\nSTUDY = " in path.read_text(encoding="utf-8")]
ALONE = ["container", "replayer", "rerun_bridge", "topic_recorder"]


def shared_files() -> list[tuple[str, list[str]]]:
    """Return what goes to share/: the ament index marker, the manifest, launch files and scenarios."""
    folders = defaultdict(list, {"share/ament_index/resource_index/packages": ["resource/lathe_rc"]})
    folders["share/lathe_rc"].append("package.xml")
    for path in sorted([*HERE.glob("launch/*.launch.py"), *HERE.glob("config/**/*.*")]):
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
    packages=find_packages(include=["lathe_rc", "lathe_rc.*", "lathe_papers", "lathe_papers.*"]),
    # lathe_rc/msg_defs is a link to msg_defs: importlib.resources finds the messages in every installation
    package_data={
        "lathe_rc": [
            "py.typed",
            "__init__.pyi",
            "*/__init__.pyi",
            "commands/completion.*",
            "nodes/*.xml",
            "msg_defs/msg/*.msg",
            "msg_defs/srv/*.srv",
            "sweep/*.j2",
            "view/*.j2",
            "view/*.css",
            "view/*.js",
            "templates/*/*.j2",
        ]
    },
    data_files=shared_files(),
    python_requires=">=3.10",
    install_requires=requirements("runtime"),
    extras_require={
        **{name: requirements(name) for name in ("formats", "notebook", "sweep", "view")},
        # pip builds the messages from their sdist, see msg_defs/pyproject.toml
        "ros": [*requirements("ros"), f"lathe_rc_msgs=={VERSION}"],
    },
    entry_points={
        "console_scripts": [
            "lathe = lathe_rc.cli:main",
            *(f"{node} = lathe_rc.nodes.executables:{node}" for node in (*NODES, *ALONE)),
        ],
        "lathe_rc.studies": [f"{study.replace('_', '-')} = lathe_papers.{study}:STUDY" for study in STUDIES],
    },
    zip_safe=False,
)
