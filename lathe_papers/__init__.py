# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of the five papers, recomputed: each module with a ``STUDY`` defines one ``lathe study``."""

__all__: list[str] = []  # no stable API
