# SPDX-License-Identifier: Apache-2.0
"""Protocol of one cell member: joining, start, progress, monitoring of other members, failure and end."""

import json
import math
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from itertools import chain, product, repeat
from typing import Any

from lathe_rc import messages
from lathe_rc.errors import InputError, LatheError
from lathe_rc.protocol import actions as do
from lathe_rc.protocol.actions import Action
from lathe_rc.protocol.messages import Announcement, BadBlock, CellState, ForeignMessage, MemberState, Phase, Progress

SILENCE = 0.08  #: [s] without DDS liveliness and progress after which a node counts as silent
GIVEN_UP = 2.0  #: [s] of silence after which a time master counts as lost in a cell that does not wait
PATIENCE = 2.0  #: [s] for other nodes to acknowledge the last messages
_REPEAT_PERIOD = 0.5  # [s] between announcements before the run, in the safe state, and after a failure
_NAMESAKE = 1.0  # [s] for the announcement of an established namesake to arrive, in a cell that runs already
_LAST_ANSWER = 1.0  # [s] for the response of a shutdown to arrive: DDS does not confirm it
_END_BY_MASTER = 1.0  # [s] for a time master that is ended by the same Ctrl-C to announce the end of the run
LONGEST_MESSAGE = 1024  #: characters of Member.msg and CellState.msg
_MOST_MEMBERS = 256  # largest number of announced names
INACTIVE = "inactive"  #: message of a member that is deactivated
_PHASES, _STATES = frozenset(Phase), frozenset(MemberState)
_WAIT_REPORTS = (2.0, 8.0, 30.0)  # [s] of waiting until each report; the last one repeats


class MemberProtocol:
    """State machine of a cell member: events are methods with monotonic time ``now`` [s], `actions` holds requests.

    Args:
        own: first announcement of this member, with the topics known so far.
        window: largest number of blocks in flight; 0: the cell is free-running.
        wired: True if all publishers and subscriptions exist once the member is active; False: only after `describe`.

    Attributes:
        actions: requests to the node, oldest first; the node empties it after each event.
        own: the newest announcement of this member.
        members: the newest announcement of each member, by fully qualified name.
        master: the newest announcement of the time master; None before the first.
        phase: phase of the cell published by the time master; None before the first message.
        active: the node is active (between activation and deactivation).
        ready: every topic is matched, and the node is prepared for its first block.
        safe: this member knows that members are lost.
        over: this member's part of the run is complete.
        done: this member may leave.
        cut: why the run ends before its planned end; empty: it does not.
        left_early: this member was ended before the run.
        failure: reason of this member's failure.
        without: lost members.
        end: end of the run [sample]; None: endless, or not known yet.
        unmatched: topics with missing peers at the last look at the graph, for messages.
        patience: longest wait for acknowledgements [s].
        silent: time since which a member is silent or stopped [s], by name.
        ended: members whose process on this machine has ended.
        look_due: time at which the next `look` is due, if that is earlier than the node's period [s].
    """

    def __init__(
        self,
        own: Announcement,
        window: int,
        *,
        wired: bool = True,
    ) -> None:
        self.own, self.window = own, window
        self._wired = wired
        self.actions: deque[Action] = deque()
        self.members: dict[str, Announcement] = {}
        self.master: Announcement | None = None
        self._former_peers: tuple[str, ...] = ()
        self._newest_states: dict[tuple[str, int], CellState] = {}  # by sender and session, of no announced time master
        self.phase: Phase | None = None
        self.active = self.ready = self.safe = self.over = self.done = False
        self.cut, self.left_early = "", False
        self.failure: LatheError | None = None
        self.without: frozenset[str] = frozenset()
        self.end: int | None = None
        self._rejected: dict[str, str] = {}  # members whose blocks are rejected, and why
        self.unmatched: Sequence[str] = ()
        self.patience = PATIENCE
        self.silent: Mapping[str, float] = {}
        self.ended: Collection[str] = ()
        self.look_due = math.inf
        self._started = self._beginning = self._leaving = False
        self.progress_step = max(1, window // 4)
        self._reported_blocks = 0
        self._moved = 0.0  # time of the last block that this member completed
        self._master_stalls = False
        self._silences: Counter[str] = Counter()  # by member
        self._repeat_due = self._time = 0.0
        self._join_due = self._leave_due = self._wait_report_due = self._end_due = math.inf
        self._ended_by = ""
        self._wait_report_after: Iterator[float] = iter(())

    # ---- lifecycle ----------------------------------------------------------------------------------

    @property
    def takes_part(self) -> bool:
        """Return True if the other members of a running cell need this member."""
        runs = self.phase in (Phase.RUNNING, Phase.SAFE)
        return runs and self.master is not None and not (self.over or self.failure)

    def activate(self, now: float) -> None:
        """Activate the member, or resume after a deactivation: messages are exchanged from now on."""
        self.active = True
        if not self._started:
            self._started = True
            self._report_waiting_from(now)
        self.announce()

    def deactivate(self) -> None:
        """Deactivate the member: node and cell pause."""
        self.active = False
        if self._started:
            self.announce()

    def clean_up(self) -> None:
        """Leave the cell, which must not begin without this member: its next announcement is a new join."""
        self.active = self.ready = False
        if self._started:
            self.announce()

    def shut_down(self, now: float) -> None:
        """Finalize the node; in mid-run the member counts as failed."""
        if self.takes_part:
            self.fail(LatheError(f"{self.own.name} was shut down in the middle of a run"))
        else:
            self._leave_before_the_run()
            self._leave_due = now + _LAST_ANSWER
        self.active = False

    def end_by(self, signal: str, now: float) -> None:
        """Handle a signal that ends the node's process; in a run, the time master has some time to end the run first.

        Ctrl-C reaches all members: then the time master ends the run for all. If it has not, this member is lost. A
        member that is ready may hear only later that the run has begun.
        """
        if self.ready and not (self.failure or self.done):
            self._ended_by, self._end_due = signal, math.inf if self.cut else now + _END_BY_MASTER
        else:
            self.interrupt(signal)
            self.done = True

    def interrupt(self, signal: str) -> None:
        """Handle a signal after which the node's process ends at once."""
        if self.takes_part:
            self.fail(LatheError(f"{self.own.name} was ended by {signal} in the middle of a run"))
        elif not (self.over or self.failure or self.done):
            self._leave_before_the_run()
            self.left_early = not self._moved
            why = f"{self.own.name} was ended by {signal}" + " before the run began" * self.left_early
            self._log("info", why)
            self._report("interrupted", message=why)

    def _leave_before_the_run(self) -> None:
        """Announce that the cell must not begin without this member."""
        if not (self.over or self.failure or self.done):
            self.clean_up()

    # ---- announcements ------------------------------------------------------------------------------

    def describe(self, **topics: tuple[object, ...]) -> None:
        """Update fields of the announcement, such as the lists of topics (see `Announcement`)."""
        self.own, self._wired = replace(self.own, **topics), True  # type: ignore[arg-type]
        self.announce()

    def announce(self) -> None:
        """Publish name, topics and state."""
        session = self.own.session if self.own.members else self._session
        pauses = INACTIVE if self.ready and not self.active else ""
        said = str(self.failure) if self.failure else pauses or "\n".join(map(": ".join, self._rejected.items()))
        self.own = replace(self.own, state=self._state(), message=said[:LONGEST_MESSAGE], session=session)
        self.members[self.own.name] = self.own
        if self.own.members:
            self.master = self.own
        self.actions.append(do.Announce(self.own))

    @property
    def _session(self) -> int:
        return self.master.session if self.master else 0

    def _state(self) -> MemberState:
        if self.failure:
            return MemberState.FAILED
        if self.safe:
            return MemberState.SAFE
        if self.ready and self.master is not None and self.own.name in self.master.members:
            return MemberState.READY  # a member that the time master does not name is an observer
        return MemberState.WIRED if self.active and self._wired else MemberState.JOINING

    def hear_member(self, member: Announcement, now: float, sender: str = "") -> None:
        """Process a member's announcement.

        Args:
            member: the message.
            now: monotonic time [s].
            sender: node that has published it, as DDS knows it; empty: not known.

        Raises:
            ForeignMessage: the sender is no member of this cell.
        """
        if member.name == self.own.name and member.process == self.own.process:
            return  # this member itself
        self._check(member, sender)
        if member.name == self.own.name:
            self._meet_namesake(member)
            return
        known, self.members[member.name] = self.members.get(member.name), member
        if member.members:
            self._hear_master(member, now)
        self.actions.append(do.Follow(member, bool(member.members or self.own.members)))
        peers = self.master.members if self.master else ()
        if len(self.members) > _MOST_MEMBERS:
            del self.members[next(n for n in reversed(self.members) if n not in peers and n != self.own.name)]
        if member.state == MemberState.FAILED and not self.over and self._is_peer(member.name):
            self.member_failed(member, now)
        elif member.rejects and self._is_peer(member.name):
            self.member_rejects(member, now)
        elif known and known.process == member.process and known.state > member.state == MemberState.JOINING:
            self.member_left(member, now)
        self.actions.append(do.MembersChanged())
        self.members_changed(now)

    def _hear_master(self, master: Announcement, now: float) -> None:
        """Process a time master's announcement: this cell's time master, or a new process of it."""
        if self.master is not None and (master.name, master.session) != (self.master.name, self.master.session):
            self._forget_master()
        self.master = master
        for sender, session in product((master.name, ""), (master.session, 0)):
            if state := self._newest_states.pop((sender, session), None):
                self.hear_cell_state(state, now, sender)

    def _forget_master(self) -> None:
        """Forget the time master and wait for another; only before the run."""
        self.master = self.phase = None
        self.ready = self._beginning = False
        self.announce()

    def _is_peer(self, name: str) -> bool:
        peers = self.master.members if self.master else self._former_peers
        return name in peers and name != self.own.name and name not in self.without

    def _check(self, member: Announcement, sender: str) -> None:
        """Reject an announcement from outside the cell."""
        why, known = "", self.members.get(member.name)
        if self.own.run_id and member.run_id != self.own.run_id:
            raise ForeignMessage("members", member.name, member.run_id, f"expected run {self.own.run_id!r}")
        if sender not in ("", member.name):
            # Counted by its sender: a flood of made-up names must not hide what others send.
            raise ForeignMessage("members", sender, member.run_id, f"it speaks as {member.name}")
        if member.state not in _STATES:
            why = f"state {member.state}; expected one of its states"
        elif member.members and not self._may_lead(member):
            why = f"the time master is {self.master.name if self.master else ''}"
        elif not len(member.publishes) == len(member.types) == len(member.sparse):
            why = "its topics, their types and what is sparse are lists of different lengths"
        elif unknown := set(member.types) - messages.signal_types():
            why = f"no signals are of type {min(unknown)}"
        elif known and known.process != member.process and self._lives(known):
            why = f"{known.name} is process {known.pid}, which has not ended"
        else:
            try:
                why = "" if isinstance(_parsed(member.parameters), dict) else "its parameters are no map"
            except (ValueError, RecursionError):
                why = "its parameters are no JSON"
        if why:
            raise ForeignMessage("members", member.name, member.run_id, why)

    def _may_lead(self, other: Announcement) -> bool:
        """Return True for the time master; before the run also for a new process of it, or if only it names this."""
        if self.master is None or (other.name, other.session) == (self.master.name, self.master.session):
            return True
        names_this = self.own.name in other.members and self.own.name not in self.master.members
        return (names_this or other.name == self.master.name) and self.phase in (None, Phase.WAITING)

    def _lives(self, member: Announcement) -> bool:
        """Return True if a process of this machine is known to be alive; False for processes of other machines."""
        if member is self.own:
            return False  # `_meet_namesake` decides
        return bool(member.pid) and member.host == self.own.host and member.name not in self.ended

    def _meet_namesake(self, other: Announcement) -> None:
        """Resolve a name conflict with another process: the newcomer fails without an announcement under that name.

        Raises:
            ForeignMessage: the other process is the newcomer.
        """
        if self.failure or self.done:
            return
        established = other.state in (MemberState.READY, MemberState.SAFE)
        # Both may be ready: a second time master in a cell that runs, or another process of a member that can resume.
        stays = self.own.process < other.process if established == self.ready else self.ready
        if stays:
            self.announce()  # the other one hears it and gives up
            why = f"this node, process {self.own.pid}, has that name"
            raise ForeignMessage("members", other.name, other.run_id, why)
        place = f"process {other.pid}" + ("" if other.host == self.own.host else " of another machine")
        self.failure = InputError(f"{self.own.name}: {place} has this name already; give this node another one")
        self._say_failure("error")
        self.done = True

    def members_changed(self, now: float) -> None:
        """React to a new announcement; only a time master does."""

    def member_failed(self, member: Announcement, now: float) -> None:
        """Handle the failure of a member; once the cell may be running, the time master decides on the reaction."""
        if not self.ready:
            self.abandon(member)

    def member_left(self, member: Announcement, now: float) -> None:
        """Handle a member that was ready and is not any more; only a time master does."""

    def member_rejects(self, member: Announcement, now: float) -> None:
        """Handle the rejection of blocks by a member; only a time master does."""

    def abandon(self, member: Announcement) -> None:
        """Fail because another member has failed."""
        self.fail(LatheError(f"{member.name} {why_failed(member)}"), cause="abandoned")

    def parameter(self, name: str, key: str) -> object:
        """Return a parameter that a member has announced; None if it has no such parameter."""
        return _parsed(self.members[name].parameters).get(key)

    def restarts(self, name: str) -> bool:
        """Return True if a member can be restarted in another process."""
        return bool(self.parameter(name, "restart_file"))

    # ---- until block 0 ------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the cell's members; without a time master, of all nodes that announced themselves."""
        return self.master.members if self.master else tuple(self.members)

    @property
    def complete(self) -> bool:
        """Return True if the time master and all members that it names have announced themselves."""
        return self.master is not None and all(name in self.members for name in self.master.members)

    @property
    def alone(self) -> bool:
        """Return True if a time master is known that names no members, as its parameters tell."""
        return any(_parsed(member.parameters).get("members") == [] for member in self.members.values())

    @property
    def wants_match(self) -> bool:
        """Return True if only topic matching is missing before the start, so that the node has to call `matched`."""
        if not self.active or self.ready or self._beginning or self.failure or not self.complete:
            return False
        if self.phase != Phase.WAITING and self._time < self._join_due:  # the cell may be running already
            return False
        assert self.master is not None, "the cell is complete"
        return all(self.members[name].state != MemberState.JOINING for name in self.master.members)

    def expected_writers(self, topic: str) -> set[str]:
        """Return the members that publish a topic."""
        return {peer.name for peer in self._peers() if topic in peer.publishes}

    def expected_readers(self, topic: str) -> set[str]:
        """Return the members that subscribe to a topic."""
        return {peer.name for peer in self._peers() if topic in peer.subscribes}

    def _peers(self) -> Iterator[Announcement]:
        names: Iterable[str] = self.master.members if self.master else ()
        return (self.members[name] for name in names if name != self.own.name and name in self.members)

    def matched(self, unmatched: Sequence[str]) -> None:
        """Process the node's look at the ROS graph.

        Args:
            unmatched: topics with missing peers, each with the names of the missing members.
        """
        self.unmatched = unmatched
        if not unmatched and self.wants_match:
            self._beginning = True
            self.actions.append(do.Begin(joins=self.phase != Phase.WAITING))

    def begun(self, now: float) -> None:
        """Record that the node is prepared for its first block."""
        self.ready, self._beginning = True, False
        self.announce()
        self._report("ready")
        self.members_changed(now)

    def missing(self) -> list[str]:
        """Return the members and topics for which this member waits; empty if there are none."""
        if self.done or self.failure or self.over or self.phase == Phase.SAFE:
            return []
        if self.ready and self.phase == Phase.RUNNING:
            return self.pausing()
        if not self.active:
            return ["its own activation"]
        if self.master is None:
            lonely = [f"a publisher of {topic}" for topic in self.unmatched]
            return [*([] if self.alone or not lonely else ["a time master"]), *lonely]
        others = [name for name in self.master.members if name != self.own.name]
        states = {name: self.members[name].state if name in self.members else None for name in others}
        absent = [name + self._near(name) for name, state in states.items() if state is None]
        absent += [f"{name} to join" for name, state in states.items() if state == MemberState.JOINING]
        if absent:
            return absent
        unready = [f"{name} to be ready" for name, state in states.items() if state == MemberState.WIRED]
        return unready if self.ready else list(self.unmatched)

    def pausing(self) -> list[str]:
        """Return the members that pause the run: for all but the time master, a time master that is silent."""
        return [f"{self.master.name}, which is silent"] if self._master_stalls and self.master else []

    def _near(self, name: str) -> str:
        """Return a hint at a node with a similar name that the time master does not name."""
        assert self.master is not None, "it names the member"
        close = get_close_matches(name, self.members.keys() - set(self.master.members), 1)
        return f" ({close[0]} is there)" if close else ""

    # ---- progress -----------------------------------------------------------------------------------

    def computed(self, blocks: int, samples: int, now: float, *, last: bool) -> None:
        """Record the number of blocks and samples completed; progress is reported to the time master at intervals."""
        self._moved = now
        # At the same blocks in every member: the time master waits for the slowest.
        if last or blocks // self.progress_step > self._reported_blocks // self.progress_step:
            self._reported_blocks = blocks
            self.actions.append(do.Tell(Progress(self.own.run_id, self.own.name, blocks, samples, self._session)))

    def resumed(self, blocks: int, samples: int) -> None:
        """Record that the node resumes in place of another process, after a number of blocks and samples."""
        self._reported_blocks = blocks
        self._log("info", f"goes on from block {blocks}")
        self._report("resumed", blocks=blocks, sample=samples)

    def reject(self, block: BadBlock, now: float) -> None:
        """Wait for the loss of a member that has sent a bad block; without a cell, nobody can declare it: fail."""
        if self.master is None or block.source not in self.master.members:
            self.fail(block)
        elif block.source not in self.without:
            self._rejected[block.source] = str(block)
            self._log("error", f"{block.source} is rejected: {block}")
            self.announce()

    # ---- the state of the cell ----------------------------------------------------------------------

    def hear_cell_state(self, state: CellState, now: float, sender: str = "") -> None:
        """Process the cell state published by the time master.

        Args:
            state: the message.
            now: monotonic time [s].
            sender: node that has published it, as DDS knows it; empty: not known.

        Raises:
            ForeignMessage: the cell state belongs to another run, or is not the time master's.
        """
        if state.run_id != self.own.run_id:
            if self.own.run_id:
                raise ForeignMessage("cell_state", "", state.run_id, f"expected run {self.own.run_id!r}")
            return
        if state.state not in _PHASES:
            raise ForeignMessage("cell_state", sender, state.run_id, f"state {state.state}; expected one of its states")
        led = self.master is not None and sender in ("", self.master.name)
        if self.master is None or not led or state.session not in (0, self.master.session):
            self._newest_states[sender, state.session] = (
                state  # from a process not announced yet, or from outside the cell
            )
            if len(self._newest_states) > _MOST_MEMBERS:
                del self._newest_states[next(iter(self._newest_states))]
            if self.master is not None and not led:
                raise ForeignMessage("cell_state", sender, state.run_id, f"the time master is {self.master.name}")
            return
        self.phase = Phase(state.state)
        self._hear_end(state)
        if self.phase != Phase.WAITING and not self.ready and self._join_due == math.inf:
            # A member that cannot resume gives up, and names its established namesake if there is one.
            self._join_due = now if self.restarts(self.own.name) else now + _NAMESAKE
        if self.failure:
            self._leave_with_the_cell()
        elif self.phase == Phase.ENDED:
            self._leave_after_the_end()
        elif self.phase == Phase.FAILED:
            self.fail(LatheError(f"the cell failed: {state.message}"), cause="abandoned")
        elif self.phase == Phase.SAFE:
            self.go_safe(state)

    def _leave_after_the_end(self) -> None:
        if self.over and not self.done:
            self.leave()
        elif not self.ready:
            self.fail(LatheError(f"{self.own.name}: the run has ended without it"), cause="abandoned")

    def _hear_end(self, state: CellState) -> None:
        """Take the end of the run: the planned one, or one that has come nearer."""
        self.end = state.end_index or self.end
        if state.state == Phase.RUNNING and state.message:
            self.cut, self._end_due = state.message, math.inf
            self.active = True  # a deactivated member resumes for the end

    def go_safe(self, state: CellState) -> None:
        """Enter the safe state, since members are lost."""
        if self.own.name in state.lost or not self.ready:
            why = f"{self.own.name}: the cell went to its safe state without it: {state.message}"
            self.fail(LatheError(why), cause="abandoned")
            return
        self.without = frozenset(state.lost)
        if not self.over:
            self.actions.append(do.Lose(self.without, state.first_index, state.end_index, self.safe))
        self.safe = True
        self.announce()
        self._log("error", f"safe state from sample {state.first_index} on: {state.message}")

    # ---- time ---------------------------------------------------------------------------------------

    def look(self, now: float, silent: Mapping[str, float], ended: Collection[str]) -> None:
        """Do the periodic work; called ten times a second, by a time master more often than `SILENCE`.

        A member that becomes silent is a reason for a further call.

        Args:
            now: monotonic time [s].
            silent: time since which each silent or stopped member has been so [s].
            ended: members whose process on this machine has ended.
        """
        self.silent, self.ended, self.look_due, self._time = silent, ended, math.inf, now
        if now >= self._leave_due:
            self.leave()
        if now >= self._end_due:
            self._end_due = math.inf
            self.interrupt(self._ended_by)
            self.done = self.done or not self.failure
        if not self._started or self.done:
            return
        self.look_after_others(now)
        waits = self.phase != Phase.RUNNING or self.failure or self._rejected or not self.ready
        if (self.master is not None or self.own.members) and waits and now >= self._repeat_due:
            self._repeat_due = now + _REPEAT_PERIOD  # a flood of messages may have displaced the last one
            self.announce()
        if now >= self._wait_report_due:
            self._wait_report_due = now + next(self._wait_report_after)
            if missing := self.missing():
                self._log("warning", f"waits for {'; '.join(missing)}")
                self._report("paused" if self.phase == Phase.RUNNING else "waits", missing=missing)

    def _report_waiting_from(self, now: float) -> None:
        """Begin to wait: the first report comes soon, the next ones later and later."""
        self._wait_report_after = chain(_WAIT_REPORTS, repeat(_WAIT_REPORTS[-1]))
        self._wait_report_due = now + next(self._wait_report_after)

    def look_after_others(self, now: float) -> None:
        """Report a silent time master, and fail if it is gone, since no further block can follow."""
        if self.master is None:
            return
        name = self.master.name
        self._name_a_silent_master(name, now)
        waits = self.parameter(name, "stall_reaction") != "safe" and not self._ended_by
        silent = 0.0 if waits else now - self.silent.get(name, math.inf)
        ended = name in self.ended
        if self.failure:
            # A time master that returns meanwhile must learn why the members are gone.
            self.done = self.done or ended or silent > 2.0 * GIVEN_UP
        elif (ended or silent > GIVEN_UP) and self.over:
            self.leave()
        elif ended and self.phase in (None, Phase.WAITING) and not self._moved:
            self._wait_for_another_master(self.master)
        elif ended:
            self.fail(LatheError(f"{name}, the time master, is lost: no sample follows"), cause="abandoned")
        elif silent > GIVEN_UP:
            self.fail(LatheError(given_up(name)), cause="masterless")

    def _wait_for_another_master(self, master: Announcement) -> None:
        """Wait for another time master after one has ended before the run; other members may have more information."""
        failed = [each for each in self._peers() if each.state == MemberState.FAILED]
        self._former_peers = master.members
        if failed:
            self.abandon(failed[0])
        else:
            self._log("warning", f"{master.name}, the time master, has ended before the run; waiting for another")
            self._forget_master()

    def _name_a_silent_master(self, name: str, now: float) -> None:
        """Report once that the time master stalls the cell, since it cannot report this itself."""
        silent = self.phase == Phase.RUNNING and name in self.silent
        if silent and not self._master_stalls:
            if now < self._moved + SILENCE:  # blocks in flight are still being computed
                self.look_due = self._moved + SILENCE
                return
            self._tell_stall(name, self._reported_blocks, now)
        self._master_stalls = silent

    def _tell_stall(self, name: str, blocks: int, now: float) -> None:
        """Report that a member is silent, with the number of blocks that it has completed; log only the first time."""
        # Report first: the first log message takes some 70 ms.
        self._report("stall", member=name, blocks=blocks)
        self._silences[name] += 1
        self._report_waiting_from(now)
        if self._silences[name] == 1:
            self._log("warning", f"{name} has been silent for {SILENCE * 1e3:.0f} ms at block {blocks}")

    # ---- failure and end ----------------------------------------------------------------------------

    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """Fail and announce the reason; ``cause`` is ``abandoned`` if another node is the cause."""
        if self.failure:
            return
        self.failure = error
        self._say_failure(cause)
        if self._started:
            self.announce()
        self._leave_with_the_cell()

    def _say_failure(self, cause: str) -> None:
        assert self.failure is not None, "it has just been set"
        self._log("error", str(self.failure))
        self._report(cause, message=str(self.failure), exit_code=self.failure.exit_code)

    @property
    def exit_code(self) -> int:
        """Return the exit code of the node's process: 0 if it completed its part of a completed run."""
        return self.failure.exit_code if self.failure else int(self.safe) * LatheError.exit_code

    def _leave_with_the_cell(self) -> None:
        """Leave after a failure, once no other member goes on."""
        self.done = self.done or self.phase in (Phase.ENDED, Phase.FAILED)

    @property
    def others_go_on(self) -> bool:
        """Return True if this member has failed while the others may still be on their way to the safe state."""
        takes_part = self.ready or self.phase == Phase.SAFE  # one that left as the run began does not end its process
        return bool(self.failure) and takes_part and self.master is not None and self.master.name != self.own.name

    def complete_part(self) -> None:
        """Complete this member's part; it stays until the cell has ended, or until its messages are acknowledged.

        DDS repeats a lost message only as long as the sending process lives. A failed node stays as well while the
        others go on: its announcement holds the reason, also for members that read it later.
        """
        self.over = True
        if self.master is None or self.master.name == self.own.name:
            self.leave(self.patience)

    def leave(self, patience: float = 0.0) -> None:
        """Request once that the node leaves, after at most ``patience`` [s] for the acknowledgement of its messages."""
        if not self._leaving:
            self._leaving = True
            for name, count in self._silences.items():
                if count > 1:
                    self._log("warning", f"{name} has been silent for {SILENCE * 1e3:.0f} ms {count} times")
            self.actions.append(do.Leave(patience))

    def left(self) -> None:
        """Record that the node has finished waiting for its last messages."""
        self.done = True

    def _log(self, level: str, text: str) -> None:
        self.actions.append(do.Log(level, text))

    def _report(self, event: str, **values: object) -> None:
        self.actions.append(do.Report(event, values))


@lru_cache(maxsize=_MOST_MEMBERS)
def _parsed(parameters: str) -> Any:
    """Parse announced parameters; cached, since each member repeats them and the time master reads them often."""
    return json.loads(parameters)


def why_failed(member: Announcement) -> str:
    """Return a member's failure message without its name at the beginning."""
    own_name = member.name.rpartition("/")[2]
    return f"failed: {member.message.removeprefix(f'{own_name}: ')}"


def given_up(master: str) -> str:
    """Return the failure message of members that stop waiting for a silent time master."""
    return f"{master}, the time master, has been silent for {GIVEN_UP:g} s: no sample follows"
