# SPDX-License-Identifier: Apache-2.0
"""The stages of the cell: physics and control laws with their parameters and ports."""

from lathe_rc.cell.stage import Stage
from lathe_rc.cell.stages.cutting_process import CuttingProcessStage
from lathe_rc.cell.stages.decoupler import DecouplerStage
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuator
from lathe_rc.cell.stages.encoder_device import EncoderDevice
from lathe_rc.cell.stages.feed_drive import FeedDriveStage
from lathe_rc.cell.stages.force_controller import ForceController
from lathe_rc.cell.stages.learning_controller import LearningController
from lathe_rc.cell.stages.loaded_drive import LoadedDriveStage, LoadedSeriesDrive
from lathe_rc.cell.stages.loaded_spindle import LoadedSpindleStage
from lathe_rc.cell.stages.piezo_actuator import PiezoActuator
from lathe_rc.cell.stages.position_controller import PositionController
from lathe_rc.cell.stages.profile import ProfileStage
from lathe_rc.cell.stages.series_drive import SeriesDriveStage
from lathe_rc.cell.stages.spindle_encoder import SpindleEncoder
from lathe_rc.cell.stages.supervisor import Supervisor
from lathe_rc.cell.stages.time_master import TimeMaster
from lathe_rc.cell.stages.tool import Tool
from lathe_rc.cell.stages.vibration import Vibration
from lathe_rc.extensions import Registry

_OWN: tuple[type[Stage], ...] = (
    SpindleEncoder,
    EncoderDevice,
    LoadedSpindleStage,
    LearningController,
    ElectrodynamicActuator,
    PiezoActuator,
    SeriesDriveStage,
    LoadedDriveStage,
    LoadedSeriesDrive,
    Vibration,
    ProfileStage,
    Tool,
    FeedDriveStage,
    CuttingProcessStage,
    PositionController,
    ForceController,
    DecouplerStage,
    Supervisor,
)

#: by name, ours and those of other packages
STAGES: Registry[Stage] = Registry("stage", Stage, {stage.kind: stage for stage in _OWN}, "lathe_rc.stages")

#: kinds of ours that give a cell its time
MASTERS = tuple(stage.kind for stage in _OWN if issubclass(stage, TimeMaster))
