# SPDX-License-Identifier: Apache-2.0
"""Completion by the shell: commands, options, scenarios, nodes and parameters, studies.

To know the options of all commands takes seconds, since that imports all. So this is done once, and kept in a file
until a module of lathe_rc has changed; `stand_in` makes commands of it that only complete.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import platformdirs
from click.shell_completion import CompletionItem

from lathe_rc import files, resources
from lathe_rc.command_list import COMMANDS, imported

_HERE = Path(__file__).parent
_SCENARIO, _TARGET, _NODE, _KIND = "scenario", "target", "node", "kind"  # of what is completed in a way of its own
_OF_NODES = {"node": "name", "container": "arguments"}  # commands, and their arguments that name kinds of nodes


def stand_in(name: str) -> click.Command:
    """A command of the command line that completes and does nothing else."""
    return _command(name, known()["commands"].get(name, {"params": []}), known()["nodes"])


# --- what is known


def _stamp() -> str:
    """Of all modules: another one as soon as one of them has changed."""
    found = hashlib.sha256()
    for path in sorted(_HERE.rglob("*.py")):
        told = path.stat()
        found.update(f"{path} {told.st_size} {told.st_mtime_ns}\n".encode())
    return found.hexdigest()[:32]


def known() -> Mapping[str, Any]:
    """From the file, which is made anew if need be; where it cannot be written, it is made each time."""
    file = platformdirs.user_cache_path("lathe_rc") / f"completion-{_stamp()}.json"
    with contextlib.suppress(OSError, ValueError):
        kept: Mapping[str, Any] = json.loads(bytes(files.unsealed(files.contents(file))))
        return kept
    found = look()
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        for old in file.parent.glob("completion-*.json"):
            old.unlink(missing_ok=True)
        with files.replacing(file) as new:
            new.write(files.sealed(json.dumps(found).encode()))
    return found


def look() -> dict[str, Any]:
    """Commands with what they take, and parameters by kind of node; a command whose packages are not here has none."""
    from lathe_rc.cell.scenario import TABLES

    commands = {}
    for name in COMMANDS:
        with contextlib.suppress(ImportError):
            commands[name] = _told(name, imported(name))
    return {"commands": commands, "nodes": {kind: list(TABLES[kind].rows()) for kind in TABLES}}


def _told(name: str, command: click.Command) -> dict[str, Any]:
    found: dict[str, Any] = {"help": command.get_short_help_str(80), "params": []}
    for parameter in command.params:
        words, of = list[str](), ""
        if isinstance(parameter.type, click.Choice):
            words = [str(choice) for choice in parameter.type.choices]
        elif isinstance(parameter.type, click.Path):
            of = "file" if parameter.type.file_okay else "dir"
        elif parameter.name == _SCENARIO or _OF_NODES.get(name) == parameter.name:
            of = _SCENARIO if parameter.name == _SCENARIO else _KIND
        elif str(parameter.metavar).startswith("NODE.PARAM"):
            of = _TARGET
        elif str(parameter.metavar).startswith("NODE+NODE"):
            of = _NODE
        elif parameter.metavar == "PARAM=VALUE":  # of a study
            words = [f"{row}=" for row in command.subject.parameters.rows()]  # type: ignore[attr-defined]
        option = isinstance(parameter, click.Option)
        found["params"].append(
            {
                "name": parameter.name,
                "given": [*parameter.opts, *parameter.secondary_opts] if option else [],
                "flag": isinstance(parameter, click.Option) and parameter.is_flag,
                "multiple": parameter.multiple or parameter.nargs < 0,
                "help": getattr(parameter, "help", None) or "",
                "words": words,
                "of": of,
            }
        )
    if isinstance(command, click.Group):
        with click.Context(command) as ctx:
            names = command.list_commands(ctx)
            subs = {each: command.get_command(ctx, each) for each in names}
        found["commands"] = {each: _told(each, sub) for each, sub in subs.items() if sub}
        found["short_for"] = getattr(command, "short_for", "")
    return found


# --- what completes


class _Leaf(click.Command):
    """Knows its other arguments also while the value of an option is being typed."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See `click.Command`."""
        options = [each for each in self.params if isinstance(each, click.Option) and not each.is_flag]
        waiting = args and any(args[-1] in option.opts for option in options)
        return super().parse_args(ctx, args[:-1] if waiting else args)


class _Group(click.Group):
    """A group one of whose commands may go without its name."""

    short_for = ""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See `click.Command`."""
        if self.short_for and args and args[0] not in self.commands:
            args = [self.short_for, *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """See `click.Command`."""
        also = _scenarios(incomplete) if self.short_for else []
        return [*super().shell_complete(ctx, incomplete), *also]


def _command(name: str, told: Mapping[str, Any], nodes: Mapping[str, list[str]]) -> click.Command:
    parameters = [_parameter(each, nodes) for each in told["params"]]
    if "commands" not in told:
        return _Leaf(name, params=parameters, short_help=told.get("help"))
    subs = [_command(each, sub, nodes) for each, sub in told["commands"].items()]
    group = _Group(name, params=parameters, commands=subs, short_help=told.get("help"), invoke_without_command=True)
    group.short_for = told["short_for"]
    return group


def _parameter(told: Mapping[str, Any], nodes: Mapping[str, list[str]]) -> click.Parameter:
    def complete(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[CompletionItem]:
        if told["words"]:
            return _beginning(told["words"], incomplete)
        if told["of"] == _SCENARIO:
            return _scenarios(incomplete)
        if told["of"] == _KIND:
            return _beginning(nodes, incomplete)
        if told["of"] == _TARGET:
            return _beginning(_targets(ctx.params.get("scenario"), nodes, incomplete), incomplete)
        if told["of"] == _NODE:
            before = incomplete.split("+")[:-1]
            others = [node for node in _nodes_of(ctx.params.get("scenario")) if node not in before]
            return _beginning(("+".join([*before, node]) for node in others), incomplete)
        return [CompletionItem(incomplete, type=told["of"])] if told["of"] else []

    given, count = told["given"], -1 if told["multiple"] and not told["given"] else 1
    if given:
        more: dict[str, Any] = {"is_flag": True} if told["flag"] else {"multiple": told["multiple"]}
        return click.Option([*given, told["name"]], help=told["help"], shell_complete=complete, **more)
    return click.Argument([told["name"]], required=False, nargs=count, shell_complete=complete)


def _beginning(words: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(word) for word in words if word.startswith(incomplete)]


def _scenarios(incomplete: str) -> list[CompletionItem]:
    """Those that come with lathe_rc; a path, as soon as it looks like one."""
    if os.sep in incomplete or incomplete.startswith((".", "~")):
        return [CompletionItem(incomplete, type="file")]
    names = {file.stem for folder in resources.config_folders() for file in folder.glob("*.yaml")}
    here = {file.name for file in Path().glob("*.yaml")}
    return _beginning(sorted(names | here), incomplete)


def _nodes_of(scenario: str | None) -> dict[str, str]:
    """The nodes of a scenario file with their kinds; empty if it cannot be read, which the command will say."""
    import yaml

    if not scenario:
        return {}
    found = {}
    path = Path(scenario) if Path(scenario).exists() or Path(scenario).suffix else Path(f"{scenario}.yaml")
    with contextlib.suppress(OSError, ValueError, yaml.YAMLError, AttributeError):
        for name, told in yaml.safe_load(resources.find(path).read_text(encoding="utf-8")).items():
            node = str(name).strip("/")
            if "*" not in node:
                found[node] = str(((told or {}).get("ros__parameters") or {}).get("stage") or node)
    return found


def _targets(scenario: str | None, nodes: Mapping[str, list[str]], incomplete: str) -> Iterator[str]:
    """NODE.PARAM= of a scenario, first the nodes alone."""
    own = _nodes_of(scenario) or {kind: kind for kind in nodes}
    node, dot, _ = incomplete.partition(".")
    if not dot:
        yield from (f"{name}." for name in own)
    elif node in own:
        yield from (f"{node}.{name}=" for name in nodes.get(own[node], ()))
