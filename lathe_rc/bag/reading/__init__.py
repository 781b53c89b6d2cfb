# SPDX-License-Identifier: Apache-2.0
"""Reading bags of any maker, piece by piece."""
