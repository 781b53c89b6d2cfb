# SPDX-License-Identifier: Apache-2.0
"""Stages of the cell: physics and control laws with their parameters and ports.

Time and angle: `time_master`, `spindle_encoder` with `speed_law`, `loaded_spindle`, `encoder_device`.
Form and tool: `form`, `tool`, `gauge`, `vibration`.
Tool drives: `drive` and `plant` (common parts), `electrodynamic_actuator`, `piezo_actuator`, `series_drive`, and
`loaded_drive`, which includes the cut; `cutting_process`.
Laws of the tool: `law` and `learner` (common parts), `learning_controller` with `learning_parameters` and
`learning_step`, `form_law` (common part), `disturbance_controller`, `compound_controller`, `resonant_controller`,
`norm_optimal_controller`.
Feed: `feed_drive`, `servo` and `trajectory` (common parts), `position_controller`, `force_controller`, `decoupler`.
Safety: `supervisor`, `obedience`, `command_limits`. Other tools: `fmu`. Building blocks of stages: `tables`, `sampled`.
"""

from lathe_rc.cell.stage import Stage
from lathe_rc.extensions import Registry

#: kinds of built-in stages that can be the time master of a cell
MASTERS = ("spindle_encoder", "encoder_device", "loaded_spindle")

# Modules are imported on demand: importing all of them takes as long as computing a hundred revolutions.
_OWN = {
    "spindle_encoder": "spindle_encoder:SpindleEncoder",
    "encoder_device": "encoder_device:EncoderDevice",
    "loaded_spindle": "loaded_spindle:LoadedSpindleStage",
    "learning_controller": "learning_controller:LearningController",
    "disturbance_controller": "disturbance_controller:DisturbanceController",
    "compound_controller": "compound_controller:CompoundController",
    "resonant_controller": "resonant_controller:ResonantController",
    "norm_optimal_controller": "norm_optimal_controller:NormOptimalController",
    "electrodynamic_actuator": "electrodynamic_actuator:ElectrodynamicActuator",
    "piezo_actuator": "piezo_actuator:PiezoActuator",
    "series_drive": "series_drive:SeriesDriveStage",
    "loaded_drive": "loaded_drive:LoadedDriveStage",
    "loaded_series_drive": "loaded_drive:LoadedSeriesDrive",
    "vibration": "vibration:Vibration",
    "profile": "form:ProfileStage",
    "tool": "tool:Tool",
    "gauge": "gauge:Gauge",
    "feed_drive": "feed_drive:FeedDriveStage",
    "cutting_process": "cutting_process:CuttingProcessStage",
    "position_controller": "position_controller:PositionController",
    "force_controller": "force_controller:ForceController",
    "decoupler": "decoupler:DecouplerStage",
    "supervisor": "supervisor:Supervisor",
    "fmu": "fmu:FmuStage",
}

#: built-in and third-party stages, by name
STAGES: Registry[Stage] = Registry(
    "stage", Stage, {kind: f"{__name__}.{place}" for kind, place in _OWN.items()}, "lathe_rc.stages"
)
