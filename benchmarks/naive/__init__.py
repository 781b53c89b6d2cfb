# SPDX-License-Identifier: Apache-2.0
"""What lathe_rc is measured against over ROS: programs that do the same in the obvious way."""
