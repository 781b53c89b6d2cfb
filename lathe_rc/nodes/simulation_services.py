# SPDX-License-Identifier: Apache-2.0
"""Services and the action of simulation_interfaces on a time master: features, state, steps.

A step is as many blocks as lie between two reports of progress of a member, a quarter of the window: only these tell
the time master that the members have completed it.
"""

import importlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from lathe_rc.errors import InputError
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.step_action import Later, Send, StepAction, serve
from lathe_rc.protocol import Pace, Phase, TimeMasterProtocol

_PACKAGE = "simulation_interfaces"
_SIGN_OF_LIFE = 10.0  # [s] between reports of a held run, which the harness otherwise takes for stuck


class _Waiting(NamedTuple):
    """Answer that waits until the members have completed a total number of blocks."""

    send: Callable[[Any], None]
    response: Any
    blocks: int


class SimulationServices:
    """Services by which a client pauses a run, lets it go on, and steps it; their names are relative to the cell.

    A client that has its answer knows that the cell stands still: each member has completed each released block.

    Args:
        node: node of the time master.
        leads: its protocol object.
        pace: schedule of its run.

    Raises:
        InputError: the message package is not installed.
    """

    def __init__(self, node: CellNode, leads: TimeMasterProtocol, pace: Pace) -> None:
        self._node, self._leads, self._pace, self._step = node, leads, pace, leads.progress_step
        try:
            self._msg, srv, action = (
                importlib.import_module(f"{_PACKAGE}.{kind}") for kind in ("msg", "srv", "action")
            )
        except ImportError:
            raise InputError(
                f"{node.get_name()}.simulation_services: no package {_PACKAGE} here; allowed: an installation by "
                "./lathe, or a ROS 2 with this package (ros-DISTRO-simulation-interfaces)"
            ) from None
        self._waiting: list[_Waiting] = []
        self._report_due = 0.0
        self._first = 0  # number of blocks at the last request
        for kind, name, callback in (
            (srv.GetSimulatorFeatures, "get_simulator_features", self._on_features),
            (srv.GetSimulationState, "get_simulation_state", self._on_get_state),
            (srv.SetSimulationState, "set_simulation_state", self._on_set_state),
            (srv.StepSimulation, "step_simulation", self._on_step),
        ):
            serve(node, kind, name, callback)
        self._action = StepAction(node, action.SimulateSteps, self._on_step, self._stop, self._is_success)

    # ---- requests -----------------------------------------------------------------------------------

    def _on_features(self, _request: Any, response: Any) -> Any:
        known = self._msg.SimulatorFeatures
        response.features.features = [
            known.SIMULATION_STATE_GETTING,
            known.SIMULATION_STATE_SETTING,
            known.SIMULATION_STATE_PAUSE,
            known.STEP_SIMULATION_SINGLE,
            known.STEP_SIMULATION_MULTIPLE,
            known.STEP_SIMULATION_ACTION,
        ]
        samples = self._step * self._node.table.block_size
        response.features.custom_info = f"a step is {samples} samples, {samples * self._node.table.step:g} s"
        return response

    def _state(self) -> int:
        state = self._msg.SimulationState
        if self._leads.phase not in (Phase.RUNNING, Phase.SAFE):
            return int(state.STATE_STOPPED)
        return int(state.STATE_PLAYING if self._leads.held_at is None else state.STATE_PAUSED)

    def _on_get_state(self, _request: Any, response: Any) -> Any:
        response.state.state = self._state()
        response.result.result = self._msg.Result.RESULT_OK
        return response

    def _on_set_state(self, request: Any, response: Any) -> Any:
        state, result, wanted = self._msg.SimulationState, self._msg.Result, request.state.state
        if wanted not in (state.STATE_PLAYING, state.STATE_PAUSED):
            text = "a cell plays or pauses; it stops with its run, and is reset by starting its processes again"
            return self._refuse(response, result.RESULT_FEATURE_UNSUPPORTED, text)
        if self._state() == state.STATE_STOPPED:
            return self._refuse(response, result.RESULT_INCORRECT_STATE, self._why_stopped())
        if self._state() == wanted:
            return self._refuse(response, response.ALREADY_IN_TARGET_STATE, "")
        if self._waiting:
            return self._refuse(response, result.RESULT_INCORRECT_STATE, "another request is under way")
        response.result.result = result.RESULT_OK
        if wanted == state.STATE_PLAYING:
            self._hold(None)
            return response
        return self._answer_at(-(-self._leads.blocks // self._step) * self._step, response)

    def _on_step(self, request: Any, response: Any) -> Any:
        state, result = self._msg.SimulationState, self._msg.Result
        if self._state() != state.STATE_PAUSED:
            why = self._why_stopped() if self._state() == state.STATE_STOPPED else "the run is not paused"
            return self._refuse(response, result.RESULT_OPERATION_FAILED, why)
        if self._waiting:
            return self._refuse(response, result.RESULT_OPERATION_FAILED, "another request is under way")
        if not request.steps:
            return self._refuse(response, result.RESULT_OPERATION_FAILED, "steps = 0; allowed: 1 or more")
        response.result.result = result.RESULT_OK
        return self._answer_at(self._leads.blocks + request.steps * self._step, response)

    def _why_stopped(self) -> str:
        if self._leads.over or self._leads.failure:
            return "the run is over"
        return f"the run has not begun: waits for {'; '.join(self._leads.missing()) or 'its check'}"

    def _refuse(self, response: Any, code: int, text: str) -> Any:
        response.result.result, response.result.error_message = code, text
        return response

    # ---- answers ------------------------------------------------------------------------------------

    def _answer_at(self, blocks: int, response: Any) -> Later:
        """Hold the run after a total number of blocks, and answer then."""
        self._first = self._leads.blocks
        self._hold(blocks)

        def wait(send: Send) -> None:
            self._waiting.append(_Waiting(send, response, blocks))
            self.look()

        return wait

    def _is_success(self, response: Any) -> bool:
        return bool(response.result.result == self._msg.Result.RESULT_OK)

    def _stop(self) -> None:
        """End the steps of an action after the one under way."""
        blocks = -(-self._leads.blocks // self._step) * self._step
        self._waiting = [waiting._replace(blocks=min(blocks, waiting.blocks)) for waiting in self._waiting]
        self._hold(blocks)
        self.look()

    def _hold(self, blocks: int | None) -> None:
        now = time.monotonic()
        self._pace.change(self._pace.block, self._leads.blocks, now)
        self._node.attempt(lambda: self._leads.hold(blocks, now))

    def tick(self, now: float) -> None:
        """Tell the harness that the run is held, and answer what a spindle without members has done."""
        self.look()
        if self._state() == self._msg.SimulationState.STATE_PAUSED and now >= self._report_due:
            self._report_due = now + _SIGN_OF_LIFE
            self._node.reporter("held", self._node.get_name(), blocks=self._leads.blocks)

    def look(self) -> None:
        """Send the answer whose blocks every member has completed, or which the end of the run overtakes."""
        if not self._waiting:
            return
        (waiting,) = self._waiting
        leads = self._leads
        self._action.tell((min(leads.least, waiting.blocks) - self._first) // self._step)
        if leads.least < waiting.blocks and not (leads.over or leads.failure or leads.held_at is None):
            return
        self._waiting.clear()
        if leads.least < waiting.blocks:
            why = str(leads.failure or ("the run is over" if leads.over else "members are lost"))
            self._refuse(waiting.response, self._msg.Result.RESULT_OPERATION_FAILED, f"at block {leads.least}: {why}")
        waiting.send(waiting.response)
