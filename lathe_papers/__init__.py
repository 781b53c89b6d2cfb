# SPDX-License-Identifier: Apache-2.0
"""Recomputed tables and figures of the five papers; each module with a ``STUDY`` defines one ``lathe study``."""

__all__: list[str] = []  # no stable API
