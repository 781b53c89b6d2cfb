# SPDX-License-Identifier: Apache-2.0
"""Words for the shell: functions for ``shell_complete=`` of options and arguments.

A shell waits for them, so each imports no more than its answer takes: NumPy alone takes longer than all of Click.
"""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from lathe_rc import resources


def beginning(words: Iterable[str], incomplete: str) -> list[CompletionItem]:
    """Return the words that begin with what is typed."""
    return [CompletionItem(word) for word in words if word.startswith(incomplete)]


def scenarios(_ctx: click.Context, _param: click.Parameter | None, incomplete: str) -> list[CompletionItem]:
    """Complete a scenario: those that come with lathe_rc and of this folder; a path, once it looks like one."""
    if os.sep in incomplete or incomplete.startswith((".", "~")):
        return [CompletionItem(incomplete, type="file")]
    names = {file.stem for folder in resources.config_folders() for file in folder.glob("*.yaml")}
    return beginning(sorted(names | {file.name for file in Path().glob("*.yaml")}), incomplete)


def kinds(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a kind of node."""
    from lathe_rc.cell.scenario import TABLES

    return beginning(TABLES, incomplete)


def nodes(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete NODE+NODE of the scenario, each node once."""
    *before, _ = incomplete.split("+")
    others = [node for node in _kinds_by_node(ctx) if node not in before]
    return beginning(("+".join([*before, node]) for node in others), incomplete)


def targets(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete NODE.PARAM= of the scenario, or of all kinds of nodes where none is named; first the node alone."""
    known = _kinds_by_node(ctx)
    node, dot, _ = incomplete.partition(".")
    if known and not dot:
        return beginning((f"{name}." for name in known), incomplete)
    from lathe_rc.cell.scenario import TABLES
    from lathe_rc.errors import InputError

    known = known or {kind: kind for kind in TABLES}
    if not dot:
        return beginning((f"{name}." for name in known), incomplete)
    with contextlib.suppress(KeyError, InputError, ImportError):  # no such kind here: the command will say so
        return beginning((f"{node}.{name}=" for name in TABLES[known[node]].rows()), incomplete)
    return []


def _kinds_by_node(ctx: click.Context) -> dict[str, str]:
    """Kinds of the nodes in the scenario of a command line; empty without a readable scenario."""
    import yaml

    # Click gives up at an option without a value, such as the one that is being typed, and leaves arguments aside.
    named = ctx.params.get("scenario") or next(iter(ctx.args), "")
    found: dict[str, str] = {}
    with contextlib.suppress(OSError, ValueError, yaml.YAMLError, AttributeError):
        path = Path(str(named))
        path = path if path.exists() or path.suffix else path.with_suffix(".yaml")
        for name, told in yaml.safe_load(resources.find(path).read_text(encoding="utf-8")).items():
            node = str(name).strip("/")
            if "*" not in node:
                found[node] = str(((told or {}).get("ros__parameters") or {}).get("stage") or node)
    return found
