# SPDX-License-Identifier: Apache-2.0
"""Reading bags of the cell back."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, ReaderError

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples
from lathe_rc.cell.recording import Recording, SparseTopic
from lathe_rc.cell.wire import Decoder
from lathe_rc.errors import InputError, LatheError


def read(path: Path) -> Recording:
    """All signal topics of a bag.

    Raises:
        InputError: not a bag.
        LatheError: a block is missing or repeated.
    """
    parts: dict[str, dict[str, list[Samples]]] = {}
    sparse: dict[str, SparseTopic] = {}
    expected: dict[str, int] = {}
    decoders: dict[str, Decoder] = {}
    types: dict[str, str] = {}
    try:
        with Reader(path) as reader:
            known = messages.block_types() | messages.sparse_types()
            wanted = [connection for connection in reader.connections if connection.msgtype in known]
            for connection in wanted:
                types[connection.topic] = connection.msgtype
                if connection.msgtype in messages.block_types():
                    decoders[connection.topic] = Decoder(connection.msgtype)
                    parts[connection.topic] = {name: [] for name in messages.sample_fields(connection.msgtype)}
                    expected[connection.topic] = 0
                else:
                    sparse[connection.topic] = SparseTopic()
            for connection, stamp, data in reader.messages(wanted):
                topic = connection.topic
                if topic in sparse:
                    sparse[topic].add(stamp, messages.decode(connection.msgtype, bytes(data)))
                    continue
                block = decoders[topic].decode(bytes(data))
                if block.first_index != expected[topic]:
                    raise LatheError(f"{path}: {topic} goes from sample {expected[topic]} to {block.first_index}")
                expected[topic] += block.samples
                for name, arrays in parts[topic].items():
                    arrays.append(block.signals[name])
    except (ReaderError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable bag ({error})") from None
    dense = {
        topic: {name: np.concatenate(arrays) if arrays else np.empty(0) for name, arrays in fields.items()}
        for topic, fields in parts.items()
    }
    return Recording(types, dense, sparse)
