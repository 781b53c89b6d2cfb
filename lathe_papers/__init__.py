# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of the five papers, computed anew: each module with a ``STUDY`` is one of ``lathe study``."""

__all__: list[str] = []  # all of it may change
