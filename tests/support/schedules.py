# SPDX-License-Identifier: Apache-2.0
"""Schedules of simulated cells, each drawn from a seed, and the guarantees that each cell keeps.

A schedule draws a cell of 3 to 13 members, in one or several processes on one or two machines, and its disturbances:
delays, kills, stops, cuts, slow members, bad blocks, lifecycle calls, holds, foreign nodes. `unsafe` and `hanging`
check the guarantees of docs/cell.md. The same seed gives the same schedule.
"""

import random
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from simulation import RESTART_TIME, SIZE, STEP_NS, Design, Member, Process, Simulation, encoder_of, safe_value

from lathe_rc.protocol import Announcement, CellState, Progress, TimeMasterProtocol

PATIENCE = 30.0  # [s] after which an operator ends a cell that waits for a dead machine


def draw_designs(draw: random.Random) -> tuple[Design, ...]:
    """Draw a cell: a chain of stages with branches and feedback, and a recorder of all topics."""
    count = draw.choice((1, 2, 2, 3, 3, 3, 4, 4, 5, 7, 11))
    names = ["/spindle", *(f"/stage_{number}" for number in range(count))]
    designs = []
    restarting = draw.randrange(1, count + 1) if draw.random() < 0.5 else 0
    for place, name in enumerate(names):
        inputs = {}
        if place:
            inputs = dict.fromkeys(draw.sample(names[:place], min(place, draw.choice((1, 1, 2)))), 0)
        if place < count and draw.random() < (0.15 if place == 0 else 0.3):
            inputs |= {other: draw.choice((1, 1, 2)) for other in draw.sample(names[place + 1 :], 1)}
        designs.append(Design(name, tuple(inputs.items()), restarts=bool(place) and place == restarting))
    return (*designs, Design("/recorder", tuple((name, 0) for name in names)))


def draw_groups(draw: random.Random, designs: tuple[Design, ...]) -> list[tuple[Design, ...]]:
    """Draw which members share a process: none, some or all; a member that can be restarted has its own."""
    processes = draw.choice((len(designs), len(designs), 2, 1))
    groups: dict[int, tuple[Design, ...]] = {}
    for place, design in enumerate(designs):
        alone = design.restarts or processes == len(designs)
        key = -place if alone else 1000 + draw.randrange(processes)
        groups[key] = (*groups.get(key, ()), design)
    return list(groups.values())


class Schedule:
    """Disturbances of a cell, drawn from a seed; `Simulation.plan` has everything that was drawn."""

    def __init__(self, seed: int) -> None:
        draw = random.Random(f"schedule {seed}")  # noqa: S311 - as above
        designs = draw_designs(draw)
        length = draw.randrange(4, 25)
        window = draw.choice((1, 2, 3, 4, 8, 8, 0))
        if not window:
            designs = tuple(replace(design, restarts=False) for design in designs)
        groups = draw_groups(draw, designs)
        loops = any(delay for design in designs for _, delay in design.inputs)  # a lost block would stop a loop
        free = {"block_time": 0.005, "loses": draw.choice((0.0, 0.02)) * (not loops)} if not window else {}
        free |= {"devices": draw.random() < 0.5} if not window else {}
        drawn: dict[str, Any] = {
            "block_time": draw.choice((0.0, 0.0, 0.0, 0.002, 0.01)),
            "groups": groups,
            "away": draw.sample(range(len(groups)), draw.choice((0, 0, 0, min(1, len(groups) - 1)))),
            "rest": draw.choice((0, 0, 1, 3)),
            "encodes": draw.random() < 0.3,
            "safe_samples": draw.choice((3 * SIZE, SIZE, 3 * SIZE + 1)),
        } | free
        stalls = draw.choice(("wait", "wait", "safe"))
        self._ended: list[Process] = []  # by a signal, so that another process can be started
        self.cell = cell = Simulation(seed, designs, window, length, stalls, **drawn)
        cell.slow_match = draw.choice((0.005, 0.05, 0.05, 0.3))
        drawn["groups"] = " | ".join("+".join(design.name for design in group) for group in groups)
        drawn |= {"window": window, "length": length, "stalls": stalls, "slow_match": cell.slow_match}
        cell.plan.append(f"{'; '.join(map(str, designs))}; {drawn}")
        for group in groups:
            cell.at(draw.choice((0.0, 0.02, 0.3)) * draw.random(), partial(cell.start, *group))
        if cell.away:
            cell.at(PATIENCE, self._lose_patience)
        kinds = (*self._HARMLESS, *self._HARMFUL)
        for kind in draw.choices(kinds, k=draw.choice((0, 1, 1, 1, 2, 3))):
            design = draw.choice(designs)
            name, seconds = design.name, draw.choice((0.02, 0.1, 0.3, 2.5, 5.0)) * draw.random()
            when = draw.randrange(1, length + 1) if draw.random() < 0.7 else 0.4 * draw.random()
            other = draw.choice(designs)
            cell.plan.append(
                f"{kind} {name} at {f'block {when}' if isinstance(when, int) else f'{when:.3f} s'}, {seconds:.3f} s, "
                f"{other.name}"
            )
            call = partial(getattr(self, f"_{kind}"), design, seconds, other)
            if isinstance(when, int):
                cell.at_block.setdefault(when, []).append(call)
            else:
                cell.at(when, call)

    _HARMLESS = ("stop", "stop", "cut", "slow", "pause", "stranger", "namesake", "dawdle", "hold")
    _HARMFUL = (
        *("kill", "kill", "kill", "interrupt", "terminate", "end_all", "shutdown", "clean_up", "claim", "freeze"),
        *("spoil", "spoil"),
    )

    def _relaunch(self, group: tuple[Design, ...]) -> None:
        """Start another process of members, once the one in which a member is shutting down has left."""
        members, names = [each for design in group if (each := self._member(design))], {each.name for each in group}
        shut_down = [each for each in members if each.protocol.done and not each.protocol.over]
        if shut_down or any(not member.protocol.active for member in members):
            process = members[0].process
            if any(member.protocol.done for member in members) and process not in self._ended:
                self._ended.append(process)
                self.cell.killed |= dict.fromkeys(names, self.cell.now)
                process.end_by("SIGTERM")  # it goes on with its other nodes
            self.cell.at(self.cell.now + 0.1, partial(self._relaunch, group))
        elif not members:
            self.cell.start(*group)

    def _running(self) -> bool:
        """Return True if block 0 has been released."""
        return any(event == "block0" for _, _, event, _ in self.cell.reports)

    def _member(self, design: Design) -> Member | None:
        return self.cell.process_of(design.name)

    def _blame(self, *members: Member) -> None:
        self.cell.culprits |= {each.full_name for member in members for each in member.process.members}

    def _blame_if_running(self, member: Member) -> None:
        if self._running():
            self._blame(member)

    # ---- disturbances: each takes a member, a time [s] and another member

    def _stop(self, design: Design, seconds: float, other: Design) -> None:
        if member := self._member(design):
            self.cell.stop(member, seconds)
            if (self.cell.stalls == "safe" or self.cell.devices) and seconds > 0.3:  # a quiet device counts as lost
                self._blame(member)

    def _freeze(self, design: Design, seconds: float, other: Design) -> None:
        """Stop a process for good, if the cell shall not wait."""
        if (member := self._member(design)) and self.cell.stalls == "safe" and self._running():
            self._blame(member)
            self.cell.stop(member, 1e9)

    def _spoil(self, design: Design, seconds: float, other: Design) -> None:
        """Let a member send a bad block."""
        member, held = self._member(design), design.restarts or design.records
        if not self.cell.window and design.name == self.cell.master:
            return  # its gap lets the others run ahead
        if member and not held and self._running():
            self._blame(member)
            self.cell.spoiled = True
            member.spoils = 1 + int(seconds * 1e6)

    def _dawdle(self, design: Design, seconds: float, other: Design) -> None:
        """Let the begin of the safe state take its time: the cell has to wait for it."""
        if member := self._member(design):
            member.dawdles = min(seconds, 1.5 / len(member.process.members))

    def _cut(self, design: Design, seconds: float, other: Design) -> None:
        one, another = self._member(design), self._member(other)
        if one and another and one.process is not another.process:
            self.cell.network.cut(one.identity, another.identity, self.cell.now + seconds)
            if (self.cell.stalls == "safe" or self.cell.devices) and seconds > 0.3:
                self._blame(*self.cell.members.values())  # all wait for each other, and the first of them is lost

    def _slow(self, design: Design, seconds: float, other: Design) -> None:
        if member := self._member(design):
            process, designs = member.process, self.cell.designs
            process.cost = min(seconds, 0.02 / len(process.members))
            blocks = sum((len(each.design.inputs) + 1) * each.protocol.progress_step for each in process.members)
            announcements = 2 * len(designs) * len(process.members)  # in the safe state, on top of the blocks
            if self.cell.stalls == "safe" and process.cost * (blocks + announcements) > 0.2:
                # It reports nothing for longer than ``stall_time``; a slow time master reads no reports for as long.
                leads = any(each.full_name == self.cell.master for each in process.members)
                self.cell.culprits |= {
                    each.name for each in (designs if leads else [e.design for e in process.members])
                }

    def _pause(self, design: Design, seconds: float, other: Design) -> None:
        """Deactivate a node, and activate it again."""
        free, member = not self.cell.window, self._member(design)
        if member and free and not all(queue.received for queue in member.role.inputs.queues.values()):
            return  # it must not miss the first block
        if member and member.protocol.active and (member.role.blocks or not free):
            member.attempt(member.protocol.deactivate)
            self.cell.at(self.cell.now + min(seconds, 0.3), partial(self._resume, member))
            if self.cell.stalls == "safe" or free:
                self._blame(member)

    def _resume(self, member: Member) -> None:
        if member.alive and not member.protocol.done:
            member.activate()
            member.process.turn()

    def _hold(self, design: Design, seconds: float, other: Design) -> None:
        """Hold the run, let it make a step, and let it go on."""
        master = self._member(self.cell.designs[0])
        if master and self._running():
            protocol = master.protocol
            assert isinstance(protocol, TimeMasterProtocol)
            for time, blocks in ((0.0, protocol.blocks + 1), (seconds, protocol.blocks + 3), (2 * seconds, None)):
                self.cell.at(self.cell.now + time, partial(self._hold_at, master, blocks))

    def _hold_at(self, master: Member, blocks: int | None) -> None:
        if master.alive:
            assert isinstance(master.protocol, TimeMasterProtocol)
            master.attempt(master.protocol.hold, blocks, self.cell.now)
            master.process.turn()

    def _stranger(self, design: Design, seconds: float, other: Design) -> None:
        """Send announcements, cell states, progress and blocks from outside the cell, and from another session."""
        if member := self._member(design):
            for sender, message in (
                ("/spindle", Announcement("another", "/spindle", "spindle_encoder", 2, ("/spindle",))),
                ("/second", Announcement("run", "/second", "spindle_encoder", 2, ("/second",))),
                ("/ghost", Announcement("run", other.name, "tool", 3, message="no")),
                ("/ghost", Announcement("run", other.name, "tool", 77)),
            ):
                member.take("members", message, sender)
            for state in (
                CellState("another", 3, 0),
                CellState("run", 77, 0),
                CellState("run", 4, 0, "", 9, (other.name,)),
            ):
                member.take("cell_state", state, "/ghost")
            member.take("cell_state", CellState("run", 3, 0, "of another start", session=7), self.cell.master)
            member.take("progress", Progress("run", other.name, 10**6, 10**7), "/ghost")
            member.take("progress", Progress("run", other.name, 10**6, 10**7, 7), other.name)
            member.take(other.name, bytes(7), "/ghost")
            member.take(other.name, bytes(7), "")
            for source, sender in (("/ghost", "/ghost"), (other.name, "/ghost")):
                zeros = {"position": np.zeros(SIZE)}
                block = encoder_of("run", source, STEP_NS).block(self.cell.first, zeros, None, last=False, companions=0)
                member.take(other.name, block, sender)

    def _namesake(self, design: Design, seconds: float, other: Design) -> None:
        """Start a second node with a member's name."""
        other_master = design.name == self.cell.master and self.cell.away  # members that wait would follow it
        if (member := self._member(design)) and self._running() and not other_master:
            if not design.restarts:  # it may compute what it receives before it hears of the cell
                self._blame(member)
                self.cell.spoiled = True
            self.cell.start(design).namesake = True

    def _kill(self, design: Design, seconds: float, other: Design) -> None:
        if member := self._member(design):
            self._blame_if_running(member)
            self.cell.kill(member)
            self._bring_back(member, seconds)

    def _bring_back(self, member: Member, seconds: float) -> None:
        """Restart members: the harness, if the member can resume; an operator, any member before the run."""
        if member.design.restarts or not self._running():
            group = tuple(each.design for each in member.process.members)
            self.cell.at(self.cell.now + min(seconds, 0.5), partial(self._relaunch, group))

    def _lose_patience(self) -> None:
        """End a cell that waits for a machine that does not answer, as an operator does."""
        stalled = any(event == "stall" for _, _, event, _ in self.cell.reports)
        if self.cell.culprits or self.cell.killed or stalled:
            self._ctrl_c()

    def _ctrl_c(self) -> None:
        """End all processes, the slow ones by a second signal."""
        for process in {member.process: None for member in self.cell.members.values()}:
            self._blame(process.members[0])
            if process.alive and not process.stopped:
                process.end_by("SIGINT")

    def _end_all(self, design: Design, seconds: float, other: Design) -> None:
        """Press Ctrl-C in a running cell."""
        if self._running():
            self._ctrl_c()

    def _terminate(self, design: Design, seconds: float, other: Design) -> None:
        """End a process by SIGTERM: a time master ends the run."""
        if (member := self._member(design)) and self._running() and not member.process.stopped:
            self._blame(member)
            member.process.end_by("SIGTERM")

    def _interrupt(self, design: Design, seconds: float, other: Design) -> None:
        """End a process at once by a second SIGTERM."""
        if member := self._member(design):
            self._blame_if_running(member)
            self.cell.killed |= {each.full_name: self.cell.now for each in member.process.members}
            for each in member.process.members:
                each.attempt(each.protocol.interrupt, "SIGTERM")
            self.cell.leave(member.process)
            if not self._running():
                self._bring_back(member, seconds)

    def _shutdown(self, design: Design, seconds: float, other: Design) -> None:
        if member := self._member(design):
            self._blame_if_running(member)
            member.attempt(member.protocol.shut_down, self.cell.now)
            member.process.turn()
            if not self._running():
                self.cell.killed[design.name] = self.cell.now
                group = tuple(each.design for each in member.process.members)
                self.cell.at(self.cell.now + 1.2 + min(seconds, 0.5), partial(self._relaunch, group))

    def _clean_up(self, design: Design, seconds: float, other: Design) -> None:
        """Clean up a node before the run, and activate it at once or later."""
        if (member := self._member(design)) and not member.protocol.takes_part and not self._running():
            self.cell.killed[design.name] = self.cell.now  # the run may begin before the others receive it
            member.attempt(member.protocol.clean_up)
            member.configure()
            self.cell.at(self.cell.now + seconds, partial(self._resume, member))

    def _claim(self, design: Design, seconds: float, other: Design) -> None:
        """Report progress of a member for blocks that were never sent."""
        master, member = self._member(self.cell.designs[0]), self._member(design)
        if master and member and design.name != self.cell.master and self._running():
            self._blame(member)
            master.take("progress", Progress("run", design.name, 10**6, 10**7), design.name)


# ---- guarantees


def violations(cell: Simulation) -> list[str]:
    """Return the guarantees of safety and liveness that a cell has violated, after `Simulation.run`."""
    return [*unsafe(cell), *hanging(cell)]


def hanging(cell: Simulation) -> list[str]:
    """Return what has not come to its end: processes, and a bag with every block if nothing has prevented it."""
    left = [each for each in cell.members.values() if not _waits_for_another(each)]
    found = [f"{each.identity} hangs" for each in left if not (each.process.stopped and cell.stalls == "safe")]
    everyone, _, lost = _outcome(cell)
    if not (cell.culprits or lost or cell.loses):
        failed = [(each.identity, str(each.protocol.failure)) for each in everyone if each.protocol.exit_code]
        # A member may leave in the instant in which the run begins; some then hear of the time master's end alone.
        gone = [name for name in cell.killed if any(name in why for _, why in failed)]
        gone += [cell.master] * bool(gone)
        found += [f"{name}: {why}" for name, why in failed if not any(name in why for name in gone)]
        recorders = [each for each in everyone if each.design.records and each.role.blocks == cell.length]
        if not recorders and not cell.killed:
            found.append("no recorder has every block")
    return found


def _outcome(cell: Simulation) -> tuple[list[Member], int, set[str]]:
    """Return all members that were not killed, the first block of the safe state, and the lost members."""
    reports = [values for _, _, event, values in cell.reports if event == "safe"]
    everyone = [member for member in (*cell.gone, *cell.members.values()) if not member.namesake]
    safe = cell.block(reports[0]["sample"] if reports else cell.end)
    return everyone, safe, {name for values in reports for name in values["lost"]}


def unsafe(cell: Simulation) -> list[str]:
    """Return wrong values, lost members that are not to blame, and members that are not at their safe position."""
    found = [cell.overrun] if cell.overrun else []
    everyone, safe, lost = _outcome(cell)
    for _, _, event, values in cell.reports:
        if event == "safe" and values["end"] != _end_of_safe(cell, safe):
            found.append(f"a safe state from block {safe} ends with sample {values['end']}")
    found += _wrong_values(cell, everyone, safe)
    to_blame = cell.culprits | cell.killed.keys()
    if not lost <= to_blame:
        found.append(f"lost {sorted(lost)}; {sorted(to_blame)} are to blame")
    found += [f"{name} was not waited for" for name in _lost_too_early(cell)]
    reacts = {time for time, _, event, _ in cell.reports if event in ("safe", "error")}
    found += [
        f"{values['member']} has died, and the cell waits"
        for time, _, event, values in cell.reports
        if event == "dead" and not values["restarts"] and time not in reacts
    ]
    # A new process of a killed member may be too late for the end of the run.
    failed = [each for each in everyone if each.protocol.failure and each.full_name not in cell.killed]
    causes = [str(each.protocol.failure) for each in failed]
    ahead = cell.spoiled and not cell.window  # a gap in a free-running cell lets readers run ahead of the time master
    named = to_blame | (_fed_by(cell, to_blame) if cell.devices or ahead else set())
    if causes and not cell.loses and not any(name in text for name in named for text in causes):
        found.append(f"none of {causes} names {sorted(named)}")
    return found


def _fed_by(cell: Simulation, names: Collection[str]) -> set[str]:
    """Return the members that wait for some others: their readers cannot tell that from a device that loses blocks."""
    found = set(names)
    for _ in cell.designs:
        found |= {each.name for each in cell.designs if found & {name for name, _ in each.inputs}}
    return found - set(names)


def _end_of_safe(cell: Simulation, safe: int) -> int:
    """Return the end of the run [sample] with a safe state from a block on."""
    return cell.end if safe == cell.block(cell.end) else cell.first + safe * SIZE + cell.safe_samples


def _wrong_values(cell: Simulation, everyone: list[Member], safe: int) -> list[str]:
    """Return which members have computed other values than offline up to the safe state, or than the safe ones."""
    found, expected = [], cell.expected()
    held = min((index for member in (*everyone, *cell.dead) for index in member.role.held.values()), default=safe)
    second = [each.role for each in (*cell.gone, *cell.members.values(), *cell.dead) if each.namesake]
    # A reader cannot tell the blocks of a namesake that has not heard of the cell yet from those that it expects.
    held = min([held, *(cell.block(role.samples) - len(role.values) for role in second if role.values)])
    for member in everyone:
        protocol, values = member.protocol, member.role.values
        certain = values[: min(safe, held)]
        if certain != expected[member.full_name][: len(certain)]:
            found.append(f"{member.identity} has computed other values than offline")
        if protocol.safe and protocol.over and not protocol.failure:
            found += _not_at_rest(member, cell, safe)
        if protocol.over and not protocol.failure:
            if member.role.samples != _end_of_safe(cell, safe):
                found.append(f"{member.identity} is done at sample {member.role.samples}")
            if any(queue.lost for queue in member.role.inputs.queues.values()):
                found.append(f"{member.identity} has lost blocks without a word")
        if len(values) > max(cell.length, cell.block(_end_of_safe(cell, safe))):
            found.append(f"{member.identity} ran beyond the end")
        words, why = ("missing", "twice", "heard before"), str(protocol.failure)
        # Another process of a member that died in the instant of block 0 may miss this block.
        late = any(name in why for name in cell.killed)
        if protocol.failure and not cell.spoiled and any(word in why for word in words) and not late:
            found.append(f"{member.identity}: {protocol.failure}")
    return found


def _not_at_rest(member: Member, cell: Simulation, safe: int) -> Iterator[str]:
    """Yield what a member lacks at the end of the safe state: its own safe position, or in the bag that of others."""
    blocks, role = cell.block(_end_of_safe(cell, safe)) - safe, member.role
    if member.full_name != cell.master and role.values[safe:] != [safe_value(member.full_name)] * blocks:
        yield f"{member.identity} is not at its safe position"
    left = role.heard.keys() - member.protocol.without - {cell.master} if member.design.records else ()
    yield from (f"the bag lacks {name}" for name in left if role.heard[name][safe:] != [safe_value(name)] * blocks)


def _lost_too_early(cell: Simulation) -> Iterator[str]:
    """Yield the members that were lost alone and dead, although another process of them could still come."""
    died: dict[str, float] = {}
    lost: set[str] = set()
    for time, _, event, values in cell.reports:
        if event == "dead" and values["restarts"]:
            died[values["member"]] = time
        if event == "safe":
            new, lost = set(values["lost"]) - lost, set(values["lost"])
            yield from (
                name
                for name in new
                if len(new) == 1 and f"{name} died" in values["why"] and time - died.get(name, -1.0) < RESTART_TIME
            )


def _waits_for_another(member: Member) -> bool:
    """Return True if a member waits for another time master, or is done in a process in which a member does."""
    return _lacks_master(member) or (member.protocol.done and any(map(_lacks_master, member.process.members)))


def _lacks_master(member: Member) -> bool:
    """Return True if a member has lost its time master, or is a second node of one name, or waits for such a master.

    Such a member reports this; an operator ends it, or starts another time master.
    """
    master, cell = member.protocol.master, member.cell
    named = master is not None and member.full_name in master.members
    masters = [each for each in cell.members.values() if each.full_name == cell.master]
    return member.namesake or (all(each.namesake for each in masters) if masters else not named)


def play(seed: int) -> tuple[Simulation, list[str]]:
    """Play the schedule of a seed; return the cell and its violations."""
    cell = Schedule(seed).cell
    cell.run()
    return cell, violations(cell)
