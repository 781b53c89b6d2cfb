# SPDX-License-Identifier: Apache-2.0
"""Views of results: reports, charts and Rerun recordings."""

__all__ = ["rerun_blueprint", "rerun_pieces", "rerun_scene"]
