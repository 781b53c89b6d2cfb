# SPDX-License-Identifier: Apache-2.0
"""Action ``simulate_steps`` of simulation_interfaces, from the services and topics of which an action consists.

rclpy's action server would need rclpy's executor, which costs more than the messages (see `lathe_rc.nodes.executor`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal

from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.ports import latched_qos

NAME = "simulate_steps"
_MOST = 64  # goals whose results are kept

Send = Callable[[Any], None]  #: sends an answer
Later = Callable[[Send], None]  #: takes the function that sends the answer


def serve(node: CellNode, kind: Any, name: str, callback: Callable[[Any, Any], Any]) -> None:
    """Create a service whose callback returns its answer, or a `Later` if the answer has to wait."""
    service: Any = node.create_service(kind, name, callback)
    send = service.send_response

    def answer(found: Any, header: Any) -> None:
        if callable(found):
            found(lambda response: send(response, header))
        else:
            send(found, header)

    service.send_response = answer


@dataclass
class _Goal:
    """Goal of a client: its number of steps, its state, and the requests for its result."""

    info: Any
    steps: int
    completed: int = 0
    state: int = GoalStatus.STATUS_EXECUTING
    result: Any = None
    waiting: list[Send] = field(default_factory=list)


class StepAction:
    """Server of the action ``simulate_steps``.

    Args:
        node: node of the time master.
        kind: the action, ``simulation_interfaces.action.SimulateSteps``.
        step: takes a goal and an empty result; returns the result, or a `Later` until the steps are done.
        stop: ends the current goal after the steps under way.
        succeeds: returns True if a result is one of success.
    """

    def __init__(
        self,
        node: CellNode,
        kind: Any,
        step: Callable[[Any, Any], Any],
        stop: Callable[[], None],
        succeeds: Callable[[Any], bool],
    ) -> None:
        self._node, self._kind, self._step, self._stop, self._succeeds = node, kind, step, stop, succeeds
        self._goals: dict[bytes, _Goal] = {}
        self._now: _Goal | None = None
        place, parts = f"{NAME}/_action", kind.Impl
        self._feedback = node.create_publisher(parts.FeedbackMessage, f"{place}/feedback", 10)
        self._status = node.create_publisher(GoalStatusArray, f"{place}/status", latched_qos(1))
        serve(node, parts.SendGoalService, f"{place}/send_goal", self._on_goal)
        serve(node, parts.GetResultService, f"{place}/get_result", self._on_result)
        serve(node, CancelGoal, f"{place}/cancel_goal", self._on_cancel)

    def _on_goal(self, request: Any, response: Any) -> Any:
        response.accepted, response.stamp = True, self._node.get_clock().now().to_msg()
        info = GoalInfo(goal_id=request.goal_id, stamp=response.stamp)
        goal = self._goals[bytes(request.goal_id.uuid)] = _Goal(info, request.goal.steps)
        if len(self._goals) > _MOST:
            del self._goals[next(iter(self._goals))]
        found = self._step(request.goal, self._kind.Result())
        if callable(found):
            self._now = goal
            self._tell_states()
            found(lambda result: self._finish(goal, result))
        else:
            self._finish(goal, found)
        return response

    def _finish(self, goal: _Goal, result: Any) -> None:
        self._now = None if self._now is goal else self._now
        cancelled = goal.state == GoalStatus.STATUS_CANCELING
        done = GoalStatus.STATUS_CANCELED if cancelled else GoalStatus.STATUS_SUCCEEDED
        goal.result, goal.state = result, done if self._succeeds(result) else GoalStatus.STATUS_ABORTED
        while goal.waiting:
            goal.waiting.pop()(self._answer(goal))
        self._tell_states()

    def _answer(self, goal: _Goal) -> Any:
        return self._kind.Impl.GetResultService.Response(status=goal.state, result=goal.result)

    def _on_result(self, request: Any, response: Any) -> Any:
        goal = self._goals.get(bytes(request.goal_id.uuid))
        if goal is None:
            return response  # STATUS_UNKNOWN
        return goal.waiting.append if goal.result is None else self._answer(goal)

    def _on_cancel(self, request: Any, response: Any) -> Any:
        goal, asked = self._now, bytes(request.goal_info.goal_id.uuid)
        if goal is None or (any(asked) and self._goals.get(asked) is not goal):
            response.return_code = response.ERROR_UNKNOWN_GOAL_ID
            return response
        goal.state = GoalStatus.STATUS_CANCELING
        response.goals_canceling = [goal.info]
        self._stop()
        return response

    def tell(self, completed: int) -> None:
        """Publish the number of steps that the current goal has completed."""
        if (goal := self._now) is not None and completed > goal.completed:
            goal.completed = completed
            feedback = self._kind.Feedback(completed_steps=completed, remaining_steps=max(goal.steps - completed, 0))
            self._feedback.publish(self._kind.Impl.FeedbackMessage(goal_id=goal.info.goal_id, feedback=feedback))

    def _tell_states(self) -> None:
        states = [GoalStatus(goal_info=goal.info, status=goal.state) for goal in self._goals.values()]
        self._status.publish(GoalStatusArray(status_list=states))
