# SPDX-License-Identifier: Apache-2.0
"""The commands of ``lathe`` that have a file of their own, each named as its file."""
