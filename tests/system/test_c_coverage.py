# SPDX-License-Identifier: Apache-2.0
"""Branches of the printed steps that runs of the engine take, and those that none takes, by kind.

``LATHE_CAMPAIGN=whole ./lathe python -m pytest -s tests/system/test_c_coverage.py`` prints them.
"""

import json
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from bags import some
from c_libraries import built

from lathe_export.c_library.sources import export_nodes
from lathe_rc.cell.scenario import load

pytestmark = pytest.mark.system

SAMPLES = 40_000
FILES = {"offset": "height_mm,offset_um\n-1,0\n0.01,1\n1,3\n", "path": "time_s,position_um\n0.05,0\n0.2,20\n0.4,10\n"}
LAW, DRIVE, FEED = "learning_controller.", "electrodynamic_actuator.", "longitudinal."
MODE = [f"{DRIVE}mode_frequency=[5655.0]", f"{DRIVE}mode_damping=[0.02]", f"{DRIVE}mode_participation=[1e-4]"]
GIVEN = [f"{LAW}publish_margin=false", "supervisor.margin_limit=[]"]
BOTH = [*GIVEN, "fine_controller.publish_margin=false"]
SPOTS = [f"cutting_process.hard_spot_{each}" for each in ("start=[1.0]", "width=[0.5]", "bottom=[1.0]", "top=[2.0]")]
#: whole cells, with other parameters, that take further branches
RUNS: list[tuple[str, list[str]]] = [
    ("supervised_full_cell", BOTH),
    ("supervised_full_cell", [*BOTH, "supervisor.force_low=1e3", "supervisor.force_after=1.5"]),
    ("supervised_two_channel", BOTH),
    ("supervised", [*GIVEN, "supervisor.effort_limit=[0.1]", "supervisor.error_limit=0.0"]),
    ("supervised", [*GIVEN, "supervisor.following_time=0.0", "supervisor.speed_limit=0.0"]),
    ("oval3000_hard", ["gauge.events=[]"]),
    ("series", []),
    ("series", ["series_drive.fine_hysteresis=none", "series_drive.coarse_sampling_jitter=1e-6"]),
    ("approach", []),
    ("vibration", []),
    ("exact_invariance", []),
    ("lead_lag", []),
    ("two_channel", ["piezo_actuator.hysteresis=bouc_wen", "piezo_actuator.slew_rate=1e5"]),
    ("two_channel", ["piezo_actuator.hysteresis=bouc_wen", "piezo_actuator.linearisation=none"]),
    ("two_channel", ["piezo_actuator.stroke=5e-6", "piezo_actuator.creep_per_decade=0.02"]),
    ("piston", [*MODE, f"{DRIVE}sampling_jitter=1e-6", f"{DRIVE}resolution=1e-8", f"{LAW}law=time_periodic"]),
    ("piston", [*MODE, f"{DRIVE}mode_drift=0.3", f"{DRIVE}gain_drift=0.1", f"{DRIVE}drift_time=0.05"]),
    ("piston", [f"{DRIVE}gain_drift=0.1", f"{DRIVE}drift_time=0.05", f"{DRIVE}sampling_jitter=1e-6"]),
    ("piston", [f"{LAW}correction=fir", f"{LAW}correction_taps=[0.9,0.1]", f"{LAW}correction_interval=1e-5"]),
    ("piston", [f"{LAW}lead_law=constant_angle", f"{LAW}soft_start=2.0", f"{LAW}join_below=1e-3",
                f"{LAW}cycle_weights=[2.0,1.0]"]),
    ("piston", [f"{LAW}lead_law=variable_second_order", f"{LAW}acceleration_window=64",
                "tool.error_motion_order=[3]", "tool.error_motion_amplitude=[1e-6]"]),
    ("piston", [f"{LAW}correction=second_order_inverse_dynamic", f"{LAW}lead_time=0.36e-3"]),
    ("piston", [f"{DRIVE}command_stroke=0.2e-3", f"{DRIVE}command_velocity=0.02", f"{DRIVE}command_acceleration=2.0",
                f"{DRIVE}command_jerk=1000.0"]),
    ("piston", ["spindle_encoder.counts_per_revolution=4096", "spindle_encoder.edge_clock=1e-8",
                "spindle_encoder.disc_eccentricity=1e-4", "spindle_encoder.signal_skew=0.01"]),
    ("piston", ["spindle_encoder.counts_per_revolution=4096", "spindle_encoder.reads_per_sample=8",
                "spindle_encoder.tachogram_time=[0.1,0.2,0.4]", "spindle_encoder.tachogram_deviation=[0.0,0.05,-0.02]",
                "spindle_encoder.deviation_amplitude=[]", "spindle_encoder.deviation_frequency=[]"]),
    ("piston", ["tool.feed=20e-3", "tool.tip_radius=1e-3"]),
    ("robust", ["disturbance_controller.inverse=fourth_order", "disturbance_controller.learning_gain=0.0", *MODE]),
    ("robust", ["disturbance_controller.inverse=fourth_order", "spindle_encoder.deviation_start=0.2",
                "disturbance_controller.events=['second 0.4: freeze','second 0.6: learn']"]),
    ("robust", ["disturbance_controller.inverse=fourth_order"]),
    ("robust_cutting", ["loaded_drive.cut_blank=round", "loaded_drive.coarse_loop=current"]),
    ("gauged", ["gauge.dropouts_per_revolution=2.0", "gauge.gap_start=[1.0]", "gauge.gap_width=[0.3]",
                "gauge.noise_rms=0.0", "loaded_drive.cut_regeneration=0.5"]),
    ("gauged", ["controller.identify=false", "controller.follows_speed=false"]),
    ("loaded_cutting", ["loaded_drive.coarse_command_stroke=0.3e-3", "spindle_encoder.belt_stiffness=1e4",
                        "spindle_encoder.torque_limit=0.0", "loaded_drive.cut_elasticity=realistic"]),
    ("full_cell", ["cross.speed_limit=1e-3", "cross.pitch_amplitude=1e-6", "cutting_process.flank_pressure=4e13",
                   f"{FEED}friction=lugre", "cutting_process.regeneration=0.5"]),
    ("full_cell", ["cross.friction=stribeck", "cross.backlash=1e-6", "position_controller.set_point=[0.0,1e-5]",
                   "position_controller.set_point_time=[0.05,0.2]", "position_controller.set_point_smoothing=0.01",
                   *SPOTS, "cutting_process.hard_spot_factor=[1.5]", "cutting_process.blank=round"]),
    ("full_cell", ["position_controller.predistortion_file={folder}/offset.csv",
                   "position_controller.trajectory=csv", "position_controller.trajectory_file={folder}/path.csv"]),
    ("force_turning", [f"{FEED}friction=stribeck", f"{FEED}feedback=motor", f"{FEED}disturbance=0.1"]),
    ("force_turning", [f"{FEED}command_stroke=0.01", f"{FEED}command_velocity=0.005", f"{FEED}command_acceleration=0.1",
                       f"{FEED}command_jerk=10.0"]),
    ("force_turning", ["force_controller.set_point=[150.0,100.0]", "force_controller.set_point_time=[0.0,0.2]",
                       "force_controller.divisor=64", "force_controller.adc_step=1.0",
                       "cutting_process.noise_rms=1.0"]),
    ("force_turning", ["cutting_process.run_out_amplitude=[200e-6]", "cutting_process.regeneration=0.5"]),
    ("periodic", ["feed_drive.command_stroke=0.5", "position_controller.command_limit=0.5"]),
]  # fmt: skip
#: why a sound run does not take a branch: a pattern of FUNCTION: LINE
KINDS = {
    "memory of temporary arrays is used up": r"room->full|^real_empty:",
    "after a reaction or an alarm, at which a library stops": (
        r"^(obedience|bounded|rules|supervisor_step|learning_step_lose|learning_step_step|pid_enable|periodic_freeze|"
        r"angle_memory_leave|drive_followed|position_controller_look)|stop == start|start == [n0]\b|who|LOST|INSIDE|"
        r"STANDS|WAITS|frozen|listens|falls_back|asks|ASKS|REPLACED"
    ),
    "a stage cannot go on": r"reason|isnan\(chip\)|largest_|^law_grows",
    "an index or a divisor that is 0 or out of bounds": (
        r"^(at|int_\w+|real_part|octet_part|real_remainder|real_put|search_right|hysteresis_travel|"
        r"identification_excited|electrodynamic_between_stops):"
    ),
}  # fmt: skip
Branch = tuple[str, str, int, int]  #: function, line, how often the line was in the function before, and number in it


def counted(place: Path) -> Counter[Branch]:
    """How often the example of a library took each branch of its steps and of kernels.h; it must agree with the engine.

    A kernel of several libraries has the same function and lines in each.
    """
    program = built(place, "-O0", "--coverage")
    done = subprocess.run([program, "reference.bin", "0"], cwd=place, capture_output=True, text=True, check=False)
    assert "the bits of the engine" in done.stdout, done.stdout + done.stderr
    command = ["gcov", "--json-format", "--branch-probabilities", "--stdout", *place.glob("*.gcda")]
    reports = subprocess.run(command, cwd=place, capture_output=True, text=True, check=True).stdout.splitlines()
    found = Counter[Branch]()
    for file in (file for report in reports for file in json.loads(report)["files"]):
        name = Path(file["file"]).name
        if not name.endswith("_step.c") and name != "kernels.h":
            continue
        text, seen = (place / name).read_text().splitlines(), dict[tuple[str, str], list[int]]()
        for line in file["lines"]:
            key = line.get("function_name", ""), text[line["line_number"] - 1].strip()
            known = seen.setdefault(key, [])
            if line["line_number"] not in known:
                known.append(line["line_number"])
            for number, branch in enumerate(line["branches"]):
                found[(*key, known.index(line["line_number"]), number)] += branch["count"]
    return found


@pytest.mark.timeout(1800)
def test_runs_of_the_engine_take_the_branches_of_the_printed_steps(tmp_path):
    """91 % of those that a sound run can take; the rest is listed by kind."""
    for name, text in FILES.items():
        (tmp_path / f"{name}.csv").write_text(text)
    found = Counter[Branch]()
    runs = some(RUNS, 4)
    for number, (name, values) in enumerate(runs):
        cell = load(name, [each.format(folder=tmp_path) for each in values])
        found.update(counted(export_nodes(cell, place=tmp_path / str(number), name="printed", samples=SAMPLES).place))
    left = [f"{function}: {line}" for (function, line, *_), count in found.items() if not count]
    kind_of = {each: next((kind for kind, text in KINDS.items() if re.search(text, each)), "") for each in left}
    kinds = Counter(kind_of[each] for each in left)
    for each, times in sorted(Counter(left).items(), key=lambda each: (kind_of[each[0]], each[0])):
        print(f"{kind_of[each] or 'no run has the case'}: {times} of {each}")
    taken, other = len(found) - len(left), kinds.pop("")
    print(f"{len(runs)} runs take {taken} of {len(found)} branches ({taken / len(found):.1%}); not taken:", dict(kinds))
    print(f"of the others, {taken / (taken + other):.1%} are taken; {other} are not")
    assert taken > (0.75 if runs is RUNS else 0.5) * len(found)
    assert taken > (0.9 if runs is RUNS else 0.6) * (taken + other)
