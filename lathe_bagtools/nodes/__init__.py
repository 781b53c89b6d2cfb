# SPDX-License-Identifier: Apache-2.0
"""Nodes that replay a bag and record any topics."""

__all__: list[str] = []
