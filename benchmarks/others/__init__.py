# SPDX-License-Identifier: Apache-2.0
"""The cell in the hands of others: what a user of another simulator would write."""
