# SPDX-License-Identifier: Apache-2.0
"""Formulas: steady errors, stability margins, metrology."""
