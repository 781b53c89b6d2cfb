# SPDX-License-Identifier: Apache-2.0
"""Deliberate faults of the protocol, each of which the simulation has to find: it proves that the schedules can fail.

A fault replaces a piece of a module's source while it is imported: python deliberate_faults.py NUMBER [SCHEDULES]
plays schedules with one fault until a promise is broken, and prints the seed.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from pathlib import Path
from typing import NamedTuple

MOST = 12_000  # schedules within which each fault is found
PROTOCOL = Path(__file__).parents[1] / "lathe_rc" / "protocol"


class Fault(NamedTuple):
    """A piece of a module of the protocol, another one in its place, and the mistake that this is."""

    module: str
    piece: str
    instead: str
    mistake: str


FAULTS = (
    Fault(
        "member",
        "            return MemberState.READY",
        "            return MemberState.WIRED",
        "a member is ready and does not say so",
    ),
    Fault(
        "member",
        "        if self.safe:\n            return MemberState.SAFE\n",
        "",
        "a member is safe and does not say so",
    ),
    Fault(
        "member",
        "        if self.master is None or self.master.name == self.own.name:\n            self.leave(self.patience)\n",
        "        self.leave()\n",
        "a member leaves before others have its last blocks",
    ),
    Fault(
        "member",
        "            self.actions.append(do.Lose(self.without, state.first_index, state.end_index, self.safe))\n",
        "            pass\n",
        "a safe state is announced, and lost members are waited for",
    ),
    Fault(
        "member",
        "        ended = name in self.ended\n",
        "        ended = False\n",
        "the death of the time master is overlooked",
    ),
    Fault(
        "member", "        if last or blocks // self", "        if blocks // self", "the last blocks are not reported"
    ),
    Fault(
        "member",
        "        if member.name == self.own.name:\n            self._meet_namesake(member)\n            return\n",
        "",
        "a namesake is taken for this member",
    ),
    Fault(
        "member",
        "        elif known and known.process != member.process and self._lives(known):\n",
        "        elif False:\n",
        "a namesake is taken for the member that has not ended",
    ),
    Fault(
        "member",
        "self.own.process < other.process if established == self.ready else self.ready\n",
        "self.ready\n",
        "two established namesakes both stay",
    ),
    Fault(
        "member",
        "        return names_this and self.phase in (None, Phase.WAITING)\n",
        "        return True\n",
        "a second time master takes the place of the first",
    ),
    Fault(
        "member",
        "        if self.phase != Phase.WAITING and self._time < self._join_due:  # the cell may be running already\n"
        "            return False\n",
        "",
        "a latecomer does not wait for the state of the cell",
    ),
    Fault(
        "member",
        " or state.session not in (0, self.master.session):\n",
        ":\n",
        "the state of another start of the cell is taken for this one's",
    ),
    Fault(
        "time_master",
        "        return min(self.completed.values(), default=self.blocks)\n",
        "        return max(self.completed.values(), default=self.blocks)\n",
        "the fastest member gives credit",
    ),
    Fault(
        "time_master",
        "        return self.window - (self.blocks - self.least)\n",
        "        return self.window + 1 - (self.blocks - self.least)\n",
        "the window is off by one",
    ),
    Fault(
        "time_master",
        "        self.completed[name] = progress.blocks\n",
        "        self.completed[name] += 1\n",
        "messages are counted, not the blocks that they report",
    ),
    Fault(
        "time_master",
        "        if progress.blocks > self.blocks:\n",
        "        if False:\n",
        "a member may claim blocks that were never sent",
    ),
    Fault(
        "time_master",
        "            self.unsafe = frozenset(self.completed)\n",
        "            pass\n",
        "blocks go out before all know of the safe state",
    ),
    Fault("time_master", "        self.unsafe -= members.keys()\n", "", "the word of a dead member is waited for"),
    Fault(
        "time_master",
        "self._reactions.restart_time if restarts else 0.0",
        "0.0",
        "a member that can be restarted is not waited for",
    ),
    Fault(
        "time_master",
        "        if any(now >= until for until in self._dead.values()):\n",
        "        if False:\n",
        "the deadline of a restart is forgotten",
    ),
    Fault(
        "time_master",
        "            del self.completed[name]\n            self._dead.pop(name, None)\n",
        "            self._dead.pop(name, None)\n",
        "the blocks of a lost member are waited for",
    ),
    Fault(
        "time_master",
        "            self._set_end(self.samples + self._reactions.safe_samples)\n",
        "            pass\n",
        "a safe state has no end of its own",
    ),
    Fault(
        "time_master",
        "        self.blocks_in_run = -(-(samples - self._first) // self._reactions.block_size)\n",
        "        self.blocks_in_run = -(-samples // self._reactions.block_size)\n",
        "the blocks of a run from a checkpoint are counted from sample 0",
    ),
    Fault(
        "time_master",
        'self._lose(dict.fromkeys(self._dead, "died") | {name: why}, now)',
        "self._lose({next(iter(self.completed)): why}, now)",
        "the wrong member is named",
    ),
    Fault(
        "time_master",
        "        here = member.session in (0, self.own.session) and member.name not in self.ended\n",
        "        here = True\n",
        "a member that is ready for another start of the cell is taken for ready",
    ),
    Fault(
        "time_master",
        "(max(self._reactions.stall_time, GIVEN_UP) if self._declared else self._reactions.stall_time)",
        "self._reactions.stall_time",
        "a slow begin of the safe state is taken for silence",
    ),
    Fault(
        "member",
        "        if self.master is None or block.source not in self.master.members:\n",
        "        if True:\n",
        "a bad block ends its reader",
    ),
    Fault(
        "member",
        '        if sender not in ("", member.name):\n',
        "        if False:\n",
        "the announcement of another node in a member's name is believed",
    ),
    Fault(
        "member",
        '        led = self.master is not None and sender in ("", self.master.name)\n',
        "        led = self.master is not None\n",
        "the state of the cell is heard from any node",
    ),
    Fault(
        "time_master",
        '        check_sender("progress", name, progress.run_id, sender)\n',
        "",
        "the progress of another node in a member's name is believed",
    ),
    Fault(
        "block_order",
        "        if self.repeats and first + samples <= self.end:\n            return None\n",
        "",
        "repeats after a restart are refused",
    ),
)


class _Faulty(importlib.abc.MetaPathFinder):
    """Imports one module of the protocol with a fault."""

    def __init__(self, fault: Fault) -> None:
        self._fault = fault

    def find_spec(self, name: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        if name != f"lathe_rc.protocol.{self._fault.module}":
            return None
        file = PROTOCOL / f"{self._fault.module}.py"

        class Loader(importlib.machinery.SourceFileLoader):
            def get_code(self, fullname: str) -> object:  # type: ignore[override] - never from a cache
                return compile(faulty(FAULT), str(file), "exec")

        FAULT = self._fault  # noqa: N806
        return importlib.util.spec_from_file_location(name, file, loader=Loader(name, str(file)))


def faulty(fault: Fault) -> str:
    """The source of a module with a fault."""
    source = (PROTOCOL / f"{fault.module}.py").read_text(encoding="utf-8")
    assert source.count(fault.piece) == 1, f"{fault.mistake}: its piece stands {source.count(fault.piece)} times"
    return source.replace(fault.piece, fault.instead)


def find(fault: Fault, most: int) -> int | None:
    """The first schedule that finds a fault, in this fresh interpreter; None: none does."""
    sys.meta_path.insert(0, _Faulty(fault))
    from simulation import play

    for seed in range(most):
        try:
            broken = play(seed)[1]
        except Exception as error:  # noqa: BLE001 - that is found as well
            broken = [repr(error)]
        if broken:
            print(f"schedule {seed}: {broken[0]}")
            return seed
    return None


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    sys.exit(find(FAULTS[int(sys.argv[1])], int(sys.argv[2]) if sys.argv[2:] else MOST) is None)
