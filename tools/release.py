# SPDX-License-Identifier: Apache-2.0
"""./lathe python tools/release.py DIR: write the files of a release into a new folder, and check them.

The files are made of the last commit: wheel and sdist, sdist of the messages, archive of the sources, notes, citation.
Nothing is tagged, uploaded or changed elsewhere.
"""

import argparse
import os
import subprocess
import sys
import tarfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from lathe_rc import __version__
from uv import uv
from workplace import BASE_PYTHON, ROOT, RefusalError, say

DOI = "10.0000/placeholder"  #: for that of the archive that publishes the release
_RUN = ("run", "piston", "--revolutions", "3")


def build(source: Path, folder: Path) -> None:
    """Build the sdist, the wheel from it, and the sdist of the messages.

    Args:
        source: copy of the sources, into which the build writes.
        folder: of the files.
    """
    for words in ([source], ["--sdist", source / "msg_defs"]):
        uv("build", "--quiet", "--no-create-gitignore", "--out-dir", folder, *words)


def archive(folder: Path, copy: Path) -> Path:
    """Write the archive of the sources of the last commit, and return its copy of them.

    Raises:
        RefusalError: the folder exists, or there are changes that are not committed.
    """
    if folder.exists():
        raise RefusalError(f"{folder} exists; allowed: a new folder")
    git = ["git", "-C", str(ROOT)]
    status = subprocess.run([*git, "status", "--porcelain"], check=True, stdout=subprocess.PIPE, text=True)
    if changes := status.stdout:
        raise RefusalError(f"{len(changes.splitlines())} changed files; commit them: a release is made of a commit")
    folder.mkdir(parents=True)
    file = folder / f"lathe_rc-{__version__}-source.tar.gz"
    words = ["archive", "--format=tar.gz", "--prefix=lathe_rc/", f"--output={file.absolute()}", "HEAD"]
    subprocess.run([*git, *words], check=True)
    with tarfile.open(file) as packed:
        packed.extractall(copy, filter="data")
    return copy / "lathe_rc"


def describe(source: Path, folder: Path) -> None:
    """Write the notes, which are the top section of the changelog, and the citation, with a placeholder for its DOI."""
    section = (source / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1]
    (folder / "NOTES.md").write_text(f"# {section}", encoding="utf-8")
    citation = (source / "CITATION.cff").read_text(encoding="utf-8")
    (folder / "CITATION.cff").write_text(f"{citation}doi: {DOI}\n", encoding="utf-8")


def check(folder: Path) -> None:
    """Check the metadata and the contents of the packages; run a cell without and with ROS, each in a new environment.

    Raises:
        subprocess.CalledProcessError: a check fails; its output is on the terminal.
    """
    wheel = folder.absolute() / f"lathe_rc-{__version__}-py3-none-any.whl"
    sdist, messages = (folder / f"{name}-{__version__}.tar.gz" for name in ("lathe_rc", "lathe_rc_msgs"))
    uv("tool", "run", "--quiet", "twine", "check", "--strict", wheel, sdist, messages)
    uv("tool", "run", "--quiet", "check-wheel-contents", "--ignore", "W009", wheel)  # W009 allows only one package
    with TemporaryDirectory() as home:
        for wanted, *words in ([wheel], [f"{wheel}[ros]", "--mode", "processes"]):
            programs = Path(home, "venv", "bin")
            uv("venv", "--quiet", "--clear", "--python", BASE_PYTHON, programs.parent)
            uv("pip", "install", "--quiet", "--python", programs / "python", "--find-links", folder, wanted)
            command, environ = [programs / "lathe", *_RUN, *words], {"PATH": os.defpath, "HOME": home}
            done = subprocess.run(command, cwd=home, env=environ, check=True, stdout=subprocess.PIPE, text=True)
            say(f"{Path(str(wanted)).name}: {done.stdout.splitlines()[-1]}")


def main(arguments: Sequence[str]) -> int:
    """Write the files of a release, check them and return the exit code."""
    parser = argparse.ArgumentParser("release", description="Files of a release, of the last commit; checks them.")
    parser.add_argument("folder", type=Path, metavar="DIR", help="to make; must not exist")
    folder: Path = parser.parse_args(arguments).folder
    try:
        with TemporaryDirectory() as place:
            source = archive(folder, Path(place))
            build(source, folder)
            describe(source, folder)
        check(folder)
    except RefusalError as refusal:
        say(str(refusal))
        return 2
    except subprocess.CalledProcessError as failure:
        print(failure.stdout or "", file=sys.stderr)
        say(f"{' '.join(map(str, failure.cmd))} failed with exit code {failure.returncode}: see above")
        return 1
    say(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}; put the DOI in place of {DOI}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
