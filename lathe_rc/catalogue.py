# SPDX-License-Identifier: Apache-2.0
"""Contents of this distribution by name: packages with their commands and executables, and stages.

Nothing is imported here, and nothing else in the core names what lies beside or above it.

The core, ``lathe_rc``, runs cells, reads and writes bags, and judges and shows a run. ``lathe_machine`` has physics,
laws and stages. The other packages import both and never each other; only this table knows all of them. A package that
is taken away takes its stages or commands along.
"""

from importlib.util import find_spec

COMMANDS_OF = {
    "lathe_rc": {
        "bag": "Show, check, copy and recover bags; extract a tachogram.",
        "budget": "Split the form error of a scenario by its causes.",
        "compare": "Write several runs side by side as an HTML page.",
        "container": "Run several nodes in one process.",
        "demo": "Turn a piston with ROS 2 processes and draw it.",
        "new": "Create a law, drive, stage or study of your own.",
        "node": "Run one node, or list its parameters.",
        "policy": "Write the SROS2 policy of a scenario.",
        "reference": "Print the reference of nodes and topics.",
        "report": "Write a recording as an HTML page.",
        "run": "Run a scenario to its end.",
        "study": "Compute a table or figure of the papers.",
    },
    "lathe_bagtools": {
        "record": "Record any topics into a new bag.",
        "replay": "Publish the messages of a bag again.",
        "resim": "Re-simulate a recorded cell, optionally with changes.",
    },
    "lathe_commission": {
        "correct": "Correct the programmed form of the next part.",
        "design": "Find the learning law of a scenario for a measured drive.",
        "fit": "Fit models to measurements.",
        "measure": "Measure the part turned in a recorded run.",
    },
    "lathe_explore": {
        "sweep": "Compute many variations of a scenario into a table.",
        "tune": "Search for the parameters that best meet given goals.",
    },
    "lathe_export": {
        "export": "Export a recording as tables, or stages as C, FMU or HAL component.",
    },
    "lathe_live": {
        "loop": "Show block diagram and learning loops, with settings to drag.",
        "panel": "Show a cell at work in the browser, and command it.",
        "view": "Show a bag in Rerun.",
    },
}  #: summaries of the commands, by package and name

OURS = frozenset([*COMMANDS_OF, "lathe_machine", "lathe_papers"])  #: packages of this distribution
_HERE = {package: table for package, table in COMMANDS_OF.items() if find_spec(package)}
COMMANDS = dict(sorted((name, text) for table in _HERE.values() for name, text in table.items()))
_BESIDES = {"container": "node"}  # commands defined in another command's module

#: modules of the executables that are no member of a cell
STANDALONE = {
    "container": "lathe_rc.nodes.container",
    "machine_state": "lathe_rc.nodes.machine_state",
    "replayer": "lathe_bagtools.nodes.replayer",
    "rerun_bridge": "lathe_live.nodes.rerun_bridge",
    "topic_recorder": "lathe_bagtools.nodes.topic_recorder",
}

DRAWN = "lathe_live.rerun_signals:is_drawn"  #: function that tells which message types a scene shows

#: stages of the machine by kind; their modules are imported on demand, which for all takes as long as a hundred
#: revolutions
MACHINE = {
    "spindle_encoder": "lathe_machine.stages.spindle.spindle_encoder:SpindleEncoder",
    "encoder_device": "lathe_machine.stages.spindle.encoder_device:EncoderDevice",
    "loaded_spindle": "lathe_machine.stages.spindle.loaded_spindle:LoadedSpindleStage",
    "learning_controller": "lathe_machine.stages.learning.learning_controller:LearningController",
    "disturbance_controller": "lathe_machine.stages.learning.disturbance_controller:DisturbanceController",
    "compound_controller": "lathe_machine.stages.learning.compound_controller:CompoundController",
    "resonant_controller": "lathe_machine.stages.learning.resonant_controller:ResonantController",
    "norm_optimal_controller": "lathe_machine.stages.learning.norm_optimal_controller:NormOptimalController",
    "electrodynamic_actuator": "lathe_machine.stages.drive.electrodynamic_actuator:ElectrodynamicActuator",
    "piezo_actuator": "lathe_machine.stages.drive.piezo_actuator:PiezoActuator",
    "series_drive": "lathe_machine.stages.drive.series_drive:SeriesDriveStage",
    "loaded_drive": "lathe_machine.stages.drive.loaded_drive:LoadedDriveStage",
    "loaded_series_drive": "lathe_machine.stages.drive.loaded_drive:LoadedSeriesDrive",
    "vibration": "lathe_machine.stages.cut.vibration:Vibration",
    "profile": "lathe_machine.stages.tool.form:ProfileStage",
    "tool": "lathe_machine.stages.tool.tool:Tool",
    "gauge": "lathe_machine.stages.tool.gauge:Gauge",
    "feed_drive": "lathe_machine.stages.feed.feed_drive:FeedDriveStage",
    "cutting_process": "lathe_machine.stages.cut.cutting_process:CuttingProcessStage",
    "position_controller": "lathe_machine.stages.feed.position_controller:PositionController",
    "force_controller": "lathe_machine.stages.feed.force_controller:ForceController",
    "decoupler": "lathe_machine.stages.feed.decoupler:DecouplerStage",
    "supervisor": "lathe_machine.stages.supervisor:Supervisor",
    "fmu": "lathe_machine.stages.fmu:FmuStage",
}
_IS_HERE = find_spec("lathe_machine") is not None
STAGES = MACHINE if _IS_HERE else {}  #: built-in stages by kind
#: kinds of built-in stages that can be the time master of a cell
MASTERS = ("spindle_encoder", "encoder_device", "loaded_spindle") if _IS_HERE else ()
#: roles of those that follow a real encoder, instead of a clock of their own
DEVICES = {"encoder_device": "lathe_machine.nodes.encoder_role:EncoderRole"} if _IS_HERE else {}
#: functions that a process calls before its run, so that no import stalls the run
PREPARE = ("lathe_machine.control.bounded:prepare",) if _IS_HERE else ()


def module_of(command: str) -> str:
    """Return the module of a command, which has an object of the command's name."""
    (package,) = [package for package, table in COMMANDS_OF.items() if command in table]
    return f"{package}.commands.{_BESIDES.get(command, command)}"
