# SPDX-License-Identifier: Apache-2.0
"""The environment in which lathe_rc is built and run."""

import os
import runpy
import shlex
from collections.abc import Mapping
from typing import TypedDict

import ros_wheels
from ros import SourcedRos, site_packages, split, split_own
from workplace import ROOT, VENV

# The settings of DDS that lathe's own nodes give themselves, for nodes in plain rclpy beside them.
DDS = ROOT / "lathe_rc" / "nodes" / "dds.py"
# What a shell sets for itself.
SHELL_OWN = frozenset({"_", "OLDPWD", "PWD", "SHLVL"})


class Changes(TypedDict):
    """The changes to a user's environment before lathe_rc runs in it."""

    prepend: dict[str, list[str]]
    assign: dict[str, str]


def is_path_list(name: str) -> bool:
    """Tell whether a variable holds a list of paths: PATH, PYTHONPATH, AMENT_PREFIX_PATH and their like."""
    return name.endswith("PATH")


def own_environment(ros: SourcedRos | None) -> dict[str, str]:
    """Return the least environment in which the virtual environment works: nothing of the user's is in it."""
    environ = {"PATH": os.pathsep.join([str(VENV / "bin"), os.defpath]), "VIRTUAL_ENV": str(VENV)}
    return environ if ros else environ | ros_wheels.environment(VENV, site_packages())


def build_environment(ros: SourcedRos | None) -> dict[str, str]:
    """Return the environment of the set-up's own commands.

    Without a sourced ROS 2, whatever other packages the user's shell points at must not get in.
    """
    environ = dict(os.environ)
    if ros is None:
        for name in ("CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "CONDA_PREFIX", "PYTHONHOME", "PYTHONPATH"):
            environ.pop(name, None)
    return apply(changes(own_environment(ros)), environ)


def changes(environ: Mapping[str, str]) -> Changes:
    """Return what has to be done to any environment for it to serve like this one."""
    system = os.defpath.split(os.pathsep)
    result = Changes(prepend={}, assign={})
    for name, value in environ.items():
        if is_path_list(name):
            result["prepend"][name] = [path for path in split(value) if path not in system]
        elif name not in SHELL_OWN:
            result["assign"][name] = value
    return result


def apply(wanted: Changes, environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment with the changes made.

    A user's own entries stay, those of another ./lathe do not.
    """
    result = {**environ, **wanted["assign"]}
    for name, entries in wanted["prepend"].items():
        rest = [entry for entry in split_own(environ.get(name, "")) if entry not in entries]
        result[name] = os.pathsep.join([*entries, *rest])
    return result


def run_environment(wanted: Changes, environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment in which to run lathe_rc, and nodes in plain rclpy beside it."""
    return apply(wanted, {**environ, **runpy.run_path(str(DDS))["settings"](environ)})


def shell_lines(wanted: Changes) -> str:
    """Return the changes as lines of a shell script; an entry that is there already stays where it is."""
    paths = [
        f'case ":${{{name}-}}:" in *":{entry}:"*) ;; *) export {name}="{entry}${{{name}:+:${name}}}" ;; esac\n'
        for name, entries in wanted["prepend"].items()
        for entry in reversed(entries)
    ]
    return "".join([*paths, *(f"export {name}={shlex.quote(value)}\n" for name, value in wanted["assign"].items())])


def complete(script: str, ros: SourcedRos | None) -> str:
    """Return colcon's setup script with what colcon does not know of.

    That is the virtual environment, before what was built against it; and the checkout, which goes first, so that a
    module has one path (and Numba one cache), wherever it is started.
    """
    virtual = changes(own_environment(ros))
    checkout = Changes(prepend={"PYTHONPATH": [str(ROOT)]}, assign={})
    return f"# Lines of ./lathe (tools/environment.py)\n{shell_lines(virtual)}\n{script}\n{shell_lines(checkout)}"
