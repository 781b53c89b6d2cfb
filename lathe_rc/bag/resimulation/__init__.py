# SPDX-License-Identifier: Apache-2.0
"""Computing a recorded run again behind its spindle."""
