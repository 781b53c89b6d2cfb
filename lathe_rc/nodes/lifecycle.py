# SPDX-License-Identifier: Apache-2.0
"""The lifecycle of a node as ROS 2 drives it: transitions, what they refuse, and errors in them."""

import traceback
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn

from lathe_rc.errors import LatheError, shown


class Lifecycle(LifecycleNode):
    """A node whose transitions fail by name and in one line, and never by an exception in rclpy.

    Attributes:
        active: it exchanges data.
    """

    active: bool

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Validate parameters and allocate."""
        return self._transition(state, "inactive", self._configure)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Announce itself and exchange data from now on; or go on, having been deactivated."""
        return self._transition(state, "active", self._activate)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stand still: what comes is put off, and so the cell stands still as well."""
        return self._transition(state, "inactive", self._deactivate)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Leave the cell, and be as before it was configured; not in the middle of a run, which needs its blocks."""
        if self._takes_part:
            self.get_logger().warning(
                "cleanup refused in the middle of a run; activate to go on, or shutdown to give up"
            )
            return TransitionCallbackReturn.FAILURE
        return self._transition(state, "unconfigured", self._clean_up)

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Leave; in the middle of a run as one that has failed."""
        return self._transition(state, "finalized", self._shut_down)

    def on_error(self, state: State) -> TransitionCallbackReturn:
        """Safe state: nothing is published any more."""
        self.active = False
        return TransitionCallbackReturn.SUCCESS

    def _transition(self, state: State, goal: str, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except LatheError as error:
            self.fail(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001 - rclpy would swallow it, and the cell wait for a node that is not there
            self.get_logger().error(traceback.format_exc())
            self.fail(LatheError(f"{self.get_name()}: {type(error).__name__}: {shown(error)}"))
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"{state.label} -> {goal}")
        return TransitionCallbackReturn.SUCCESS

    def _refusing(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """The lifecycle service, without the exception with which rclpy answers to what cannot be."""

        def call(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError as error:
                self.get_logger().warning(f"transition {request.transition.id} refused: {str(error).splitlines()[0]}")
                response.success = False
                return response

        return call

    @property
    @abstractmethod
    def _takes_part(self) -> bool:
        """Whether the others of a cell that runs need it."""

    @abstractmethod
    def fail(self, error: LatheError, *, cause: str = "error") -> None:
        """Give up, and say so to everyone; ``cause`` is ``abandoned`` if another node is to blame."""

    @abstractmethod
    def _configure(self) -> None:
        """Validate parameters and allocate."""

    @abstractmethod
    def _activate(self) -> None:
        """Announce itself and exchange data, or go on."""

    @abstractmethod
    def _deactivate(self) -> None:
        """Stand still."""

    @abstractmethod
    def _clean_up(self) -> None:
        """Leave the cell, and be as before it was configured."""

    @abstractmethod
    def _shut_down(self) -> None:
        """Leave."""
