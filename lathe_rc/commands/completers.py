# SPDX-License-Identifier: Apache-2.0
"""Shell completion: functions for ``shell_complete=`` of options and arguments.

Completion is interactive, so each function imports as little as possible: NumPy alone takes longer than all of Click.
"""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from lathe_rc import resources


def beginning(words: Iterable[str], incomplete: str) -> list[CompletionItem]:
    """Return the words that begin with the typed prefix."""
    return [CompletionItem(word) for word in words if word.startswith(incomplete)]


def scenarios(_ctx: click.Context, _param: click.Parameter | None, incomplete: str) -> list[CompletionItem]:
    """Complete a scenario of lathe_rc or of the current folder, or a file path if the word looks like one."""
    if os.sep in incomplete or incomplete.startswith((".", "~")):
        return [CompletionItem(incomplete, type="file")]
    names = {file.stem for folder in resources.config_folders() for file in folder.glob("*.yaml")}
    return beginning(sorted(names | {file.name for file in Path().glob("*.yaml")}), incomplete)


def kinds(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of a kind of node."""
    from lathe_rc.cell.scenario import TABLES

    return beginning(TABLES, incomplete)


def nodes(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete NODE+NODE with nodes of the scenario, each at most once."""
    *before, _ = incomplete.split("+")
    others = [node for node in _kinds_by_node(ctx) if node not in before]
    return beginning(("+".join([*before, node]) for node in others), incomplete)


def targets(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete NODE.PARAM= of the scenario, or of all kinds of nodes if the command line has no scenario.

    The node is completed first, then the parameter.
    """
    known = _kinds_by_node(ctx)
    node, dot, _ = incomplete.partition(".")
    if known and not dot:
        return beginning((f"{name}." for name in known), incomplete)
    from lathe_rc.cell.scenario import TABLES
    from lathe_rc.errors import InputError

    known = known or {kind: kind for kind in TABLES}
    if not dot:
        return beginning((f"{name}." for name in known), incomplete)
    with contextlib.suppress(KeyError, InputError, ImportError):  # unknown kind: the command will report it
        return beginning((f"{node}.{name}=" for name in TABLES[known[node]].rows()), incomplete)
    return []


def _kinds_by_node(ctx: click.Context) -> dict[str, str]:
    """Return the kinds of the nodes in the command line's scenario; empty if no scenario can be read."""
    import yaml

    # Click stops parsing at an option without a value, such as the one being typed, and skips the arguments.
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
