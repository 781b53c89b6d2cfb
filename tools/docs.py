# SPDX-License-Identifier: Apache-2.0
"""./lathe docs: the documentation as a site, served on this machine; --build writes it, --archive packs it."""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pictures
from workplace import HOME, ROOT

MKDOCS = [sys.executable, "-m", "mkdocs"]
CONFIG = ["--config-file", str(ROOT / "mkdocs.yml")]
SITE = HOME / "site"
# The makers of the theme announce its successor in each build.
QUIET = {"NO_MKDOCS_2_WARNING": "1"}
# Without what the docstrings say: takes a third of the time, for ./lathe test.
BARE = {"LATHE_DOCS": "bare"}


def build(folder: Path) -> list[str]:
    """Return the command that writes the site into a folder, and fails if anything is wrong with it."""
    return [*MKDOCS, "build", "--strict", "--quiet", *CONFIG, "--site-dir", str(folder)]


def run(command: Sequence[str], *, bare: bool = False) -> int:
    """Run MkDocs and return the exit code."""
    return subprocess.run(command, env=os.environ | QUIET | (BARE if bare else {}), check=False).returncode


def archive(file: Path) -> int:
    """Write the site as one file, and return the exit code."""
    suffix = ".tar.gz"
    if not file.name.endswith(suffix) or not file.absolute().parent.is_dir():
        print(
            f"lathe: docs --archive {file}; allowed: a name that ends in {suffix}, in a folder that exists",
            file=sys.stderr,
        )
        return 2
    name = file.name.removesuffix(suffix)
    with TemporaryDirectory() as folder:
        code = run(build(Path(folder) / name))
        if code == 0:
            shutil.make_archive(str(file.absolute().with_name(name)), "gztar", folder, name)
            print(f"archive: {file} ({file.stat().st_size / 1e6:.1f} MB)")
        return code


def main(arguments: Sequence[str]) -> int:
    """Do what the arguments say and return the exit code."""
    parser = argparse.ArgumentParser("lathe docs", description="The documentation as a site: serve it, until Ctrl-C.")
    parser.add_argument("--port", type=int, default=8000, help="where on this machine; default: 8000")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument("--build", nargs="?", type=Path, const=SITE, metavar="DIR", help="write it, to .lathe/site")
    instead.add_argument("--archive", type=Path, metavar="FILE", help="write it as one .tar.gz, for a release")
    instead.add_argument("--check", action="store_true", help="see whether it can be built, docstrings left out")
    instead.add_argument("--figures", nargs="*", metavar="NAME", help="draw pictures anew; tell which are stale")
    chosen = parser.parse_args(arguments)
    if chosen.figures is not None:
        return pictures.main(chosen.figures)
    if chosen.check:
        with TemporaryDirectory() as folder:
            return run(build(Path(folder)), bare=True)
    if chosen.archive:
        return archive(chosen.archive)
    if chosen.build:
        code = run(build(chosen.build.absolute()))
        if code == 0:
            print(f"site: {chosen.build}/index.html")
        return code
    serve = [*MKDOCS, "serve", *CONFIG, "--dev-addr", f"127.0.0.1:{chosen.port}"]
    with suppress(KeyboardInterrupt):  # that is how it ends
        return run(serve)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
