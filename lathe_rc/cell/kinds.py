# SPDX-License-Identifier: Apache-2.0
"""Stages by kind: those of the catalogue, and those of other packages."""

from lathe_rc import catalogue
from lathe_rc.cell.stage import Stage
from lathe_rc.extensions import Registry

MASTERS = catalogue.MASTERS

#: built-in and third-party stages, by name
STAGES: Registry[Stage] = Registry("stage", Stage, catalogue.STAGES, "lathe_rc.stages")
