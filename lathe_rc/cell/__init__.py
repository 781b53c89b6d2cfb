# SPDX-License-Identifier: Apache-2.0
"""What holds stages together: messages, parameter tables, wiring, the offline engine. Knows no ROS."""
