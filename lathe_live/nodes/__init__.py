# SPDX-License-Identifier: Apache-2.0
"""Nodes that listen to a running cell: the bridge to Rerun, and the panel's."""

__all__: list[str] = []
