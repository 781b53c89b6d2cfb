# SPDX-License-Identifier: Apache-2.0
"""Limits for reading a bag: above anything in real bags, but below anything that exhausts memory or takes hours.

A file of a few kilobytes may declare terabytes, so stated sizes are compared with the actual content. With these
limits, a malicious file takes a few hundred megabytes of memory, and no more time than a valid bag of its size may.
The main limits are listed in docs/bags.md.
"""

MOST_BYTES = 2**27  #: longest record, chunk or message: above images and point clouds; a reader holds several [B]
MOST_OPEN = 2**28  #: total unpacked size of chunks that overlap in time and so are in memory together [B]
MOST_TOPICS = 4096  #: topics in a bag
MOST_SENT = 1000  #: topics of one replayer: every node discovers each, and thousands take DDS minutes or crash it
MOST_TEXT = 2**20  #: longest string in the metadata, and total length of all QoS profiles [B]
MOST_METADATA = 16 * MOST_TEXT  #: length of metadata.yaml, which contains a scenario's files [B]
MOST_FILES = 4096  #: files in a folder
MOST_ANNOUNCED = 2**20  #: schemas and channels in a file without an index, including their repetitions in each chunk
MOST_BEFORE = 2**26  #: total size of latched messages from before the start of a replay [B]
LONGEST_NAME = 1024  #: longest name of a topic or type [characters]
MOST_EVENTS = 2**19  #: parser events of a YAML document
MOST_DEPTH = 32  #: nesting depth of a YAML document

# Limits on the unpacked size. Blocks of constant signals shrink to 1/100 (64 samples) or 1/900 (1024 samples), as do
# black images; a message takes at least a few bytes. Decompression bombs reach 1/32000.
EXPANSION = 1024  #: total message bytes per byte of the files
MOST_SMALL = 2**28  #: total message bytes allowed for files of any size
MOST_SMALL_MESSAGES = 2**20  #: messages allowed for files of any size, plus one per byte of the files

SIMULATED = 10**17  #: [ns] upper bound of simulated time: three years; the system clock passed it in 1973


class TooMuchError(ValueError):
    """Error for a file that exceeds the limits for its size; unlike damage, it ends reading."""
