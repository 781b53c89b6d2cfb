# SPDX-License-Identifier: Apache-2.0
"""The needs of ./lathe test --system on the machine: Debian packages, and root."""

import os
import shutil
import subprocess

from workplace import REQUIREMENTS

WAITING = ["--option", "DPkg::Lock::Timeout=600"]  # [s] another installation may be running


def packages() -> list[str]:
    """Return the packages in requirements/debian.txt."""
    lines = (REQUIREMENTS / "debian.txt").read_text(encoding="utf-8").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def missing() -> list[str]:
    """Return those that are not installed."""
    query = ["dpkg-query", "--show", "--showformat=${db:Status-Status}"]
    states = {name: subprocess.run([*query, name], capture_output=True, text=True, check=False) for name in packages()}
    return [name for name, state in states.items() if state.stdout != "installed"]


def provide() -> str:
    """Install what is missing.

    Returns:
        What stands against the tests, in one line; empty: nothing.
    """
    if os.geteuid() != 0:
        needs = "mounts a small file system and makes network namespaces"
        return f"./lathe test --system {needs}, for which it must be root: sudo ./lathe test --system"
    if shutil.which("dpkg-query") is None or shutil.which("apt-get") is None:
        return f"./lathe test --system needs {', '.join(packages())}, which it can install on Debian and Ubuntu only"
    if not (wanted := missing()):
        return ""
    print(f"installing {', '.join(wanted)}", flush=True)
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update"], ["install", "--yes", "--no-install-recommends", *wanted]):
        done = subprocess.run(["apt-get", "--quiet=2", *WAITING, *command], env=environment, check=False)
        if done.returncode:
            return f"apt-get {' '.join(command)} failed with exit code {done.returncode}: see above"
    return ""
