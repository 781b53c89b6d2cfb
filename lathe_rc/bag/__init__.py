# SPDX-License-Identifier: Apache-2.0
"""Bags: write, read, check, recover."""
