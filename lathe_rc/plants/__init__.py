# SPDX-License-Identifier: Apache-2.0
"""The plants: tool drives and the tool itself."""
