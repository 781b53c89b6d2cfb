# SPDX-License-Identifier: Apache-2.0
"""Pictures of results."""

__all__ = ["rerun_blueprint", "rerun_pieces", "rerun_scene"]
