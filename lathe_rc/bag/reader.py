# SPDX-License-Identifier: Apache-2.0
"""Reading bags of the cell back."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, ReaderError

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples
from lathe_rc.cell.recording import Recording, SparseTopic
from lathe_rc.errors import InputError, LatheError

DENSE = {messages.ENCODER, messages.COMMAND, messages.STATE, messages.TOOL}
SPARSE = {messages.LEARNING, messages.EVENT, messages.JOINTS}


def read(path: Path) -> Recording:
    """All signal topics of a bag.

    Raises:
        InputError: not a bag.
        LatheError: a block is missing or repeated.
    """
    parts: dict[str, dict[str, list[Samples]]] = {}
    sparse: dict[str, SparseTopic] = {}
    expected: dict[str, int] = {}
    types: dict[str, str] = {}
    try:
        with Reader(path) as reader:
            wanted = [connection for connection in reader.connections if connection.msgtype in DENSE | SPARSE]
            for connection in wanted:
                types[connection.topic] = connection.msgtype
                if connection.msgtype in DENSE:
                    parts[connection.topic] = {name: [] for name in messages.sample_fields(connection.msgtype)}
                    expected[connection.topic] = 0
                else:
                    sparse[connection.topic] = SparseTopic()
            for connection, stamp, data in reader.messages(wanted):
                message = messages.decode(connection.msgtype, bytes(data))
                topic = connection.topic
                if topic in sparse:
                    sparse[topic].add(stamp, message)
                    continue
                if message.block.first_index != expected[topic]:
                    raise LatheError(
                        f"{path}: {topic} goes from sample {expected[topic]} to {message.block.first_index}"
                    )
                samples = 0
                for name, arrays in parts[topic].items():
                    arrays.append(getattr(message, name))
                    samples = arrays[-1].size
                expected[topic] += samples
    except ReaderError as error:
        raise InputError(f"{path}: not a readable bag ({error})") from None
    dense = {
        topic: {name: np.concatenate(arrays) if arrays else np.empty(0) for name, arrays in fields.items()}
        for topic, fields in parts.items()
    }
    return Recording(types, dense, sparse)
