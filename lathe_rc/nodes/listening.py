# SPDX-License-Identifier: Apache-2.0
"""How a node hears topics: errors that name the topic, messages that do not belong, and order while it stands still."""

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks

from lathe_rc.cell.host_topics import signal_depth
from lathe_rc.errors import LatheError
from lathe_rc.nodes.membership import Membership
from lathe_rc.nodes.ports import message_class, signal_qos
from lathe_rc.nodes.refused_messages import ForeignMessage, RefusedMessages
from lathe_rc.nodes.report import Reporter

_MOST_PUT_OFF = 8  # times the blocks in flight of each topic, while a node is deactivated


class Listening(Membership):
    """A node whose callbacks fail it by name, and that refuses messages from outside its cell.

    Attributes:
        reporter: line to the harness.
        due: messages have come since it last worked.
        handled: messages received so far.
        refused_messages: those that do not belong to the cell.
    """

    reporter: Reporter
    due: bool
    handled: int
    refused_messages: RefusedMessages
    _put_off: deque[tuple[Callable[[Any], object], Any]]  # signals that came while deactivated
    _diagnostics_due: float

    def guarded(self, callback: Callable[[Any], object], *, always: bool = False) -> Callable[[Any], None]:
        """A callback that fails the node, by name and in one line, instead of the process with a traceback.

        Args:
            callback: takes a message.
            always: whether it also hears what comes after the node has given up.
        """

        def call(message: Any) -> None:
            self.handled += 1
            self.due = True
            if not self._host or (self.failure and not always):
                return
            try:
                callback(message)
            except ForeignMessage as refused:
                self.refused_messages.refuse(refused)
            except LatheError as error:
                self.fail(error)

        return call

    def _in_turn(self, callback: Callable[[Any], object]) -> Callable[[Any], None]:
        """A callback for signals, which are put off while the node is deactivated: then nothing is lost.

        Where nothing holds the spindle back they are left out, and counted as any that are missing.
        """
        most = _MOST_PUT_OFF * signal_depth(self.table)

        def call(message: Any) -> None:
            if self.active:
                callback(message)
            elif self.table.window:
                self._put_off.append((callback, message))
                if len(self._put_off) > most * (len(self.subscriptions_wanted()) + 1):
                    raise LatheError(f"{self.full_name}: {len(self._put_off)} messages wait until it is active again")

        return call

    def _report_refused(self, message: ForeignMessage) -> None:
        publishers = self._who_publishes(message.topic)
        self.get_logger().warning(f"refused: {message}; publishers of {message.topic}: {', '.join(publishers)}")
        self.reporter("foreign_message", self.get_name(), message=str(message), publishers=publishers)
        self._diagnostics_due = time.monotonic()

    def _one_of_many(self, topic: str, callback: Callable[[bytes], object]) -> Callable[[bytes], None]:
        """A callback whose errors name all publishers of its topic, if there are several: any of them may be it."""

        def call(data: bytes) -> None:
            try:
                callback(data)
            except ForeignMessage:
                raise
            except LatheError as error:
                if len(publishers := self._who_publishes(topic)) > 1:
                    error.args = (f"{error}; publishers of {topic}: {', '.join(publishers)}",)
                raise

        return call

    def attempt(self, step: Callable[[], None]) -> None:
        """Do something that may fail the node."""
        try:
            step()
        except LatheError as error:
            self.fail(error)

    def listen(
        self,
        topic: str,
        msgtype: str,
        callback: Callable[[bytes], object],
        inside: Callable[[Any], object],
    ) -> None:
        """Read a signal topic.

        Args:
            topic: fully qualified.
            msgtype: message type.
            callback: gets the encoded message from DDS.
            inside: gets the `lathe_rc.nodes.exchange.Delivery` of a node of this process instead.
        """
        if self.exchange.has(topic):
            self.exchange.listen(topic, self.full_name, self.guarded(self._in_turn(inside)))
            return
        self.inlets[topic] = self.create_subscription(
            message_class(msgtype),
            topic,
            self.guarded(self._in_turn(self._one_of_many(topic, callback))),
            signal_qos(self.table, topic),
            raw=True,
            event_callbacks=self.subscription_events(topic),
        )

    def subscription_events(self, topic: str) -> SubscriptionEventCallbacks:
        """Publishers that do not fit become named errors.

        To hear of lost messages as well may stop a node for ever: rmw_fastrtps 8.4 takes its own lock and then
        that of DDS where DDS takes them the other way round (its pull request 890); a flood from outside is enough.
        Nothing is missed by that: every block and every message at a chosen sample is counted by its readers.
        """

        def incompatible(status: Any) -> None:
            self.fail(
                LatheError(
                    f"{topic}: a publisher offers a quality of service that does not fit ({status.last_policy_kind}); "
                    f"if it is a device that keeps no messages, add {topic} to {self.get_name()}.volatile_inputs"
                )
            )

        return SubscriptionEventCallbacks(incompatible_qos=incompatible)
