# SPDX-License-Identifier: Apache-2.0
"""The piston cell as one would write it in an afternoon with rclpy: five processes, a message a sample.

Standard messages, callbacks, the default quality of service, `rclpy.spin` (a SingleThreadedExecutor), one sample of
arithmetic a callback, and a recorder that writes what it hears to a bag with rosbags.

python -m benchmarks.naive.piston NODE SAMPLES PACE FOLDER

PACE is ``timer``: the spindle publishes at 64 kHz, or as near as its timer comes; or ``lockstep``: when the tool has
answered the sample before. A node prints "ready" when it has met its neighbours; the spindle waits for a line of
input. The recorder prints what it has.
"""

import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float64MultiArray

RATE = 64000.0
STEP = 1.0 / RATE
DELAY = 3200  # [sample] between an error and its use
DEPTH = 10  # of the queues: what ROS gives by default
TOPICS = ("encoder", "command", "state", "tool")
READERS = {"encoder": 3, "command": 2, "state": 2, "tool": 2}  # the recorder is one of them
PATIENCE = 30.0  # [s] to meet the neighbours
SILENCE = 1.0  # [s] after which the recorder takes what it has for all there will be


class Part(Node):
    """A node: one publisher, callbacks, the number of the sample first in each message."""

    def __init__(self, name: str, output: str = "", readers: int = 0) -> None:
        super().__init__(name)
        self.output = self.create_publisher(Float64MultiArray, output, DEPTH) if output else None
        self.readers = readers

    def hear(self, topic: str, callback: Callable[[Any], None], *, raw: bool = False) -> None:
        """Subscribe."""
        self.create_subscription(Float64MultiArray, topic, callback, DEPTH, raw=raw)

    def say(self, *values: float) -> None:
        """Publish."""
        assert self.output
        self.output.publish(Float64MultiArray(data=values))

    def met(self) -> bool:
        """Whether the readers and writers of its topics are there."""
        heard = all(s.get_publisher_count() for s in self.subscriptions if s.topic_name.strip("/") in TOPICS)
        return heard and (not self.output or self.output.get_subscription_count() >= self.readers)


class Spindle(Part):
    """Angle of a spindle whose speed swings by 10 %."""

    def __init__(self, samples: int, pace: str) -> None:
        super().__init__("spindle", "encoder", READERS["encoder"])
        self.index, self.samples, self.angle, self.pace = 0, samples, 0.0, pace
        if pace == "lockstep":
            self.hear("tool", lambda _: self.step())

    def start(self) -> None:
        """Let the first sample go."""
        if self.pace == "lockstep":
            self.step()
        else:
            self.create_timer(STEP, self.step)

    def step(self) -> None:
        """One sample."""
        if self.index == self.samples:
            return
        time_s = self.index * STEP
        self.angle += 2 * math.pi * 1000 / 60 * (1 + 0.1 * math.sin(2 * math.pi * 10.7 * time_s)) * STEP
        self.say(self.index, self.angle)
        self.index += 1


class Controller(Part):
    """Repetitive control with a memory over the angle."""

    def __init__(self) -> None:
        super().__init__("controller", "command", READERS["command"])
        self.memory = np.zeros(3840)
        self.angles: deque[float] = deque(maxlen=DELAY)
        self.hear("encoder", self.step)
        self.hear("tool", self.learn)

    def place(self, angle: float) -> float:
        """Angle in places of the memory."""
        return angle % (2 * math.pi) * self.memory.size / (2 * math.pi)

    def step(self, message: Any) -> None:
        """Command of a sample."""
        index, angle = message.data
        self.angles.append(angle)
        place = self.place(angle + 104.7 * 1.425e-3)
        low = int(place)
        a, b = self.memory[low], self.memory[(low + 1) % self.memory.size]
        self.say(index, a + (b - a) * (place - low))

    def learn(self, message: Any) -> None:
        """Put an error into the memory, smoothed over its neighbours."""
        if self.angles:
            place = int(self.place(self.angles[0]))
            size = self.memory.size
            old = (self.memory[place - 1] + 2 * self.memory[place] + self.memory[(place + 1) % size]) / 4
            self.memory[place] = old + message.data[2]


class Drive(Part):
    """A drive of second order with a dead time."""

    def __init__(self) -> None:
        super().__init__("drive", "state", READERS["state"])
        self.position = self.speed = 0.0
        self.commands = deque([0.0] * round(0.36e-3 * RATE))
        self.hear("command", self.step)

    def step(self, message: Any) -> None:
        """State of a sample."""
        index, command = message.data
        self.commands.append(command)
        force = 1038.0**2 * (self.commands.popleft() - self.position) - 2 * 0.804 * 1038.0 * self.speed
        self.speed += force * STEP
        self.position += self.speed * STEP
        self.say(index, self.position, self.speed)


class Tool(Part):
    """Desired form minus position."""

    def __init__(self) -> None:
        super().__init__("tool", "tool", READERS["tool"])
        self.angles: dict[float, float] = {}
        self.positions: dict[float, float] = {}
        self.places = np.linspace(0, 2 * math.pi, 361)
        self.form = 136e-6 * (1 - np.cos(2 * self.places))
        self.hear("encoder", lambda message: self.keep(self.angles, message))
        self.hear("state", lambda message: self.keep(self.positions, message))

    def keep(self, values: dict[float, float], message: Any) -> None:
        """Error of a sample, once both of its messages have come: nothing says which is first."""
        index = message.data[0]
        values[index] = message.data[1]
        if index in self.angles and index in self.positions:
            angle, position = self.angles.pop(index), self.positions.pop(index)
            desired = float(np.interp(angle % (2 * math.pi), self.places, self.form))
            self.say(index, position, desired - position)


class Recorder(Part):
    """Writes everything to a bag."""

    def __init__(self, folder: Path, samples: int) -> None:
        super().__init__("recorder")
        self.writer = Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
        self.writer.open()
        store = get_typestore(Stores.ROS2_JAZZY)
        self.received = dict.fromkeys(TOPICS, 0)
        self.samples, self.first, self.newest = samples, 0.0, math.inf
        for topic in TOPICS:
            connection = self.writer.add_connection(f"/{topic}", "std_msgs/msg/Float64MultiArray", typestore=store)
            self.hear(topic, self.keeper(topic, connection), raw=True)
        self.create_timer(0.1, self.look)

    def keeper(self, topic: str, connection: Any) -> Callable[[bytes], None]:
        """A callback that writes a topic."""

        def keep(data: bytes) -> None:
            self.newest = time.monotonic()
            self.first = self.first or self.newest
            self.received[topic] += 1
            self.writer.write(connection, time.time_ns(), data)
            if self.received["tool"] == self.samples:
                self.end()

        return keep

    def look(self) -> None:
        """End when nothing comes any more."""
        if time.monotonic() - self.newest > SILENCE:
            self.end()

    def end(self) -> None:
        """Close the bag and say what is in it."""
        self.writer.close()
        print(json.dumps({"wall_s": self.newest - self.first, **self.received}), flush=True)
        raise ExternalShutdownException


def main(arguments: Sequence[str]) -> None:
    """Run a node."""
    name, samples, pace, folder = arguments[0], int(arguments[1]), arguments[2], Path(arguments[3])
    parts: dict[str, Callable[[], Part]] = {
        "spindle": lambda: Spindle(samples, pace),
        "controller": Controller,
        "drive": Drive,
        "tool": Tool,
        "recorder": lambda: Recorder(folder, samples),
    }
    rclpy.init()
    try:
        part = parts[name]()
        if name == "tool" and pace == "lockstep":
            part.readers += 1
        limit = time.monotonic() + PATIENCE
        while not part.met():
            rclpy.spin_once(part, timeout_sec=0.02)
            if time.monotonic() > limit:
                sys.exit(f"{name} has not met its neighbours")
        print("ready", flush=True)
        if isinstance(part, Spindle):
            sys.stdin.readline()
            part.start()
        rclpy.spin(part)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1:])
