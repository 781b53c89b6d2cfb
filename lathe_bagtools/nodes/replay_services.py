# SPDX-License-Identifier: Apache-2.0
"""Services of a replay, with the names and types of rosbag2's player."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

if TYPE_CHECKING:
    from lathe_bagtools.nodes.replayer import Replayer


class ReplayServices:
    """Services of a replay.

    Args:
        node: node that offers them.
        replay: the replay.

    Raises:
        ImportError: their package, rosbag2_interfaces, is not installed.
    """

    def __init__(self, node: Node, replay: "Replayer") -> None:
        srv: Any = import_module("rosbag2_interfaces.srv")

        self._replay = replay
        for kind, name, callback in (
            (srv.Pause, "pause", self._pause),
            (srv.Resume, "resume", self._resume),
            (srv.TogglePaused, "toggle_paused", self._toggle_paused),
            (srv.IsPaused, "is_paused", self._is_paused),
            (srv.GetRate, "get_rate", self._get_rate),
            (srv.SetRate, "set_rate", self._set_rate),
            (srv.Seek, "seek", self._seek),
            (srv.PlayNext, "play_next", self._play_next),
            (srv.Burst, "burst", self._burst),
            (srv.Stop, "stop", self._stop),
        ):
            node.create_service(kind, f"~/{name}", callback)

    def _pause(self, _request: Any, response: Any) -> Any:
        self._replay.paused = True
        return response

    def _resume(self, _request: Any, response: Any) -> Any:
        self._replay.paused = False
        return response

    def _toggle_paused(self, _request: Any, response: Any) -> Any:
        self._replay.paused = not self._replay.paused
        return response

    def _is_paused(self, _request: Any, response: Any) -> Any:
        response.paused = self._replay.paused
        return response

    def _get_rate(self, _request: Any, response: Any) -> Any:
        response.rate = self._replay.rate
        return response

    def _set_rate(self, request: Any, response: Any) -> Any:
        response.success = request.rate > 0.0 and self._replay.change_rate(request.rate)
        return response

    def _seek(self, request: Any, response: Any) -> Any:
        response.success = self._replay.seek(request.time.sec * 10**9 + request.time.nanosec)
        return response

    async def _play_next(self, _request: Any, response: Any) -> Any:
        response.success = self._replay.paused and await self._replay.step(1) == 1
        return response

    async def _burst(self, request: Any, response: Any) -> Any:
        response.actually_burst = await self._replay.step(request.num_messages) if self._replay.paused else 0
        return response

    def _stop(self, _request: Any, response: Any) -> Any:
        self._replay.stop()
        return response
