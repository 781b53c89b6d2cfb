# SPDX-License-Identifier: Apache-2.0
"""What is controlled: tool drives and the tool itself."""
