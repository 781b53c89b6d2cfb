# SPDX-License-Identifier: Apache-2.0
"""Limits for reading a bag: above anything in real bags, below anything that exhausts memory or takes hours.

A file of a few kilobytes may declare terabytes, so its statements are compared with its actual content. With these
limits a malicious file costs some hundred megabytes of memory, and no more time than a bag of its size may;
docs/bags.md lists the main limits.
"""

MOST_BYTES = 2**27  #: longest record, chunk or message: above images and point clouds; a reader holds several [B]
MOST_OPEN = 2**28  #: unpacked size of chunks that overlap in time, which are in memory together [B]
MOST_TOPICS = 4096  #: topics of a bag
MOST_SENT = 1000  #: topics of one replayer: every node discovers each; thousands take DDS minutes, or crash it
MOST_TEXT = 2**20  #: longest string in the metadata, and total length of all quality of service [B]
MOST_METADATA = 16 * MOST_TEXT  #: length of metadata.yaml, which contains a scenario's files [B]
MOST_FILES = 4096  #: files of a folder
MOST_ANNOUNCED = 2**20  #: schemas and channels, repeated in each chunk, that a file without an index may have
MOST_BEFORE = 2**26  #: latched messages from before the start of a replay [B]
LONGEST_NAME = 1024  #: longest name of a topic or type [characters]
MOST_EVENTS = 2**19  #: parser events of a YAML document
MOST_DEPTH = 32  #: nesting depth of a YAML document

# Limits of the unpacked size. Blocks of constant signals shrink to 1/100 (64 samples) or 1/900 (1024), as do black
# images; a message takes at least a few bytes. Decompression bombs reach 1/32000.
EXPANSION = 1024  #: bytes of all messages per byte of the files
MOST_SMALL = 2**28  #: bytes of all messages, whatever the size of the files
MOST_SMALL_MESSAGES = 2**20  #: messages, whatever the size of the files; beyond them one per byte


class TooMuchError(ValueError):
    """Error for a file that exceeds the limits for its size; unlike damage, it ends the reading."""
