# SPDX-License-Identifier: Apache-2.0
"""A cell that cannot run is refused in one line, and with the same one through every door."""

import re
import signal

import pytest
import yaml
from bags import lathe
from cells import SCENARIOS
from machines import line_of

from lathe_live import panel
from lathe_live.panel_run import Driver, LiveCell
from lathe_rc import harness
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.scenario import load
from lathe_rc.errors import InputError

SHARED = ("sample_rate", "block_size", "nominal_rpm", "allow_faults")
MODE = "mode_frequency=[5654.9]; mode_damping=[0.02]; mode_participation=[0.001]; drift_time=1.0; "
TWO_MODES = "mode_frequency=[5654.9, 10053.1]; mode_damping=[0.02, 0.02]"
MEASURED = "coarse/state.measured_position"
DIVERGES = "learning_controller: learning diverges with electrodynamic_actuator"
ALLOWED_RMS = "allowed: each once: rms= a number from 0 up to 1e+100"
QUIET = "; ".join(f"{name}_limit=0" for name in ("speed", "index", "error", "acceleration"))
ALONE = "; ".join(f"{name}_limit=[]" for name in ("following", "stroke", "effort", "margin"))

#: by scenario and node: changes to its parameters, and what they are refused with; ... stands for the rest of it
REFUSED = {
    "piston electrodynamic_actuator": {
        "gain=0": "electrodynamic_actuator.gain = 0; allowed: of either sign, not 0",
        "gain=-1": f"{DIVERGES}: sup|Q - Z| = 2 at 0 rad/s",
        "gain_drift=0.1": "electrodynamic_actuator.gain_drift, mode_drift, drift_time: a drift without an end; allowed",
        "gain_drift=-2; drift_time=1": "...drift_time: a gain that drifts to -1 of its start; allowed: above 0",
        "mode_drift=0.1; drift_time=1": "electrodynamic_actuator.mode_drift = 0.1 1/s; allowed: 0, or with",
        MODE + "mode_drift=40": "...drift_time: modes that move by 4000%; allowed: by 50% or less",
        MODE + "mode_frequency=[1.8e5]; mode_drift=0.4": "electrodynamic_actuator.mode_drift = ...: a mode at 252000 ",
        "sampling_jitter=2e-5": "electrodynamic_actuator.sampling_jitter = 2e-05 s; allowed: below a sample,",
        "command_velocity=-1": "electrodynamic_actuator.command_velocity = -1; allowed: a finite number from 0 [m/s]",
        TWO_MODES: "electrodynamic_actuator.mode_frequency, ...: lengths [2, 2, 0, 0]; allowed: as many of each",
        "mode_frequency=[3e5]": "electrodynamic_actuator.mode_frequency = ...: below half the sample rate, 201062 ",
        f"{TWO_MODES}; mode_participation=[0.5, 0.5]": "electrodynamic_actuator.mode_frequency, ... sum up to 1;",
        "remap=['coarse/command:=encoder']": "electrodynamic_actuator reads encoder as lathe_rc_msgs/msg/ActuatorComma",
        "events=['revolution 2: freeze']": "electrodynamic_actuator.events: event 'freeze'; allowed: none",
        "lag_participation=[0.1]": "electrodynamic_actuator.mode_frequency, ...: lags: lengths [0, 1]; allowed: as",
        "stroke=2e-4": "tool.profile: electrodynamic_actuator cannot follow it at 115.2 rad/s: stroke 272 µm; ",
        "faults=['second 1: coarse/state.position off']":
            "electrodynamic_actuator.faults: 'fault coarse/state.position off' is refused; set allow_faults = true",
        f"allow_faults=true; faults=['second 2 to 1: {MEASURED} off']":
            f"electrodynamic_actuator.faults = 'second 2 to 1: {MEASURED} off' ends before it begins; allowed: an end",
        f"allow_faults=true; faults=['some day: {MEASURED} off']": "...; allowed: 'revolution R to S: FAULT'",
        f"allow_faults=true; faults=['second nan: {MEASURED} off']": "electrodynamic_actuator.faults = 'second nan: ",
        f'allow_faults=true; faults=["second 1: {MEASURED} noisy rms=\\x1b[31m"]': "...: rms=\ufffd[31m; allowed: each",
        "allow_faults=true; events=['second 1: repair coarse/state.no']":
            "electrodynamic_actuator.events: repair 'coarse/state.no': there is no such target; allowed: coarse/",
        f"allow_faults=true; events=['second 1: repair {MEASURED} noisy']":
            f"electrodynamic_actuator.events: repair '{MEASURED} noisy': no rms; {ALLOWED_RMS}",
    },
    "piston learning_controller": {
        "lead_time=2e-3": f"{DIVERGES}: sup|Q - Z| = 1.054 at ... allowed: below 1 (learning_controller.lead_time = 0.",
        "q_time=1e-200": f"{DIVERGES}: ",
        "q_time=1": "learning_controller.q_time: Q filter reaches 471570 grid points to each side; allowed: less than",
        "feedback_delay=63": "learning_controller: feedback of encoder is delayed by 63 samples, block_size = 64;",
        "feedback_delay=1; block_size=2": "... is delayed by 1 samples, block_size = 2; allowed: block_size up to the",
        "feedback_delay=2047; block_size=2048": "... is delayed by 2047 samples, block_size = 2048; allowed: block_siz",
        "feedback_delay=100000": "...feedback_delay = 100000 samples: at 115.2 rad/s the cycle leaves 3386; allowed: ",
        "remap=['coarse/learning:=tool']": "tool is published by ",
        "identify=false; correction_model=identified": "learning_controller.correction_model = identified without",
        "lead_law=exact_preview; spindle_encoder.deviation_amplitude=[0.1]; spindle_encoder.deviation_frequency=[9]":
            "learning_controller.lead_law = exact_preview, but it does not know the speed of spindle_encoder; give it",
        "memory_file=/none; events=['revolution 2: load']": "learning_controller.memory_file: /none: the memory cannot",
        "events=['revolution 2: save']": "learning_controller.memory_file is empty; name the file for the event 'save'",
        "correction=lead_lag": "learning_controller.lead_lag_lag: lag = 0 s with correction lead_lag; allowed: above 0",
        "q_filter=fir; q_stop=100": "learning_controller.q_pass, q_stop, q_ripple: FIR Q filter: pass band to ...; as ",
        "deviation_amplitude=[0.1]": "learning_controller.deviation_amplitude, ...: 1 amplitudes, 0 frequencies and 1 ",
        "events=['sample 1: freese']": "learning_controller.events: event 'freese'; did you mean freeze?",
        "events=['sample 1: melt']": "learning_controller.events: event 'melt'; allowed: freeze, learn, clear, ",
        **{f"events=['{when}: freeze']": f"learning_controller.events = '{when}: freeze'; allowed: 'revolution R: "
           for when in ("soon", "sample -1", "sample 1e999", "sample 1-1", "second 1e300")},
        "events=['revolution 2: set gain 0.5']": "...'set gain 0.5': no PARAM of 'set PARAM VALUE'; did you mean",
        "events=['sample 2: set feedback_delay 64']": "...; allowed: learning_gain, lead_time, q_time",
        "events=['revolution 2: set learning_gain']": "learning_controller.learning_gain = ''; allowed: a finite",
        "events=['sample 2: set learning_gain 2.5']": "learning_controller.learning_gain = 2.5; allowed: a finite",
        "events=['sample 2: set q_time 0.05']": "learning_controller.q_time: Q filter reaches ...; as with q_time = ",
        "events=['sample 2: set lead_time 3e-3']": f"{DIVERGES}: ... lead_time = 3 ms...; allowed: below 1 (",
    },
    "piston tool": {
        "feed=nan": "tool.feed = nan; allowed: a finite number from 0 [m/rev]",
        "events=['sample 2: set feed 1.0']": "tool.events: event 'set feed 1.0': no PARAM of 'set PARAM VALUE';",
        "zone_start=[0]": "tool.zone_start, zone_width, zone_tolerance: lengths [1, 0, 0]; allowed: as many of each",
        "tolerance=0; zone_start=[0]; zone_width=[1]; zone_tolerance=[1e-6]": "tool.tolerance = 0 with zones; allowed",
        "zone_bottom=[0]; zone_top=[1e-3]": "tool.zone_bottom: 1 values; allowed: none, or as many as of zone_start",
        "remap=['coarse/state:=fine/state']": "tool reads fine/state, which no node of the scenario publishes; allowed",
        **{f"remap=['{rule}']": f"tool.remap = '{rule}'; allowed: old:=new"
           for rule in ("encoder", "encoder:=", ":=shaft", "encoder=shaft")},
        "programmed_file=/none.csv": "tool.programmed_file: /none.csv: cannot be read",
        "remap=['tool:=/**']": "learning_controller reads tool, which no node of the scenario publishes; allowed: a",
        "profile_file=''": "tool.profile_file is empty; name the CSV file",
        "profile_file=/no/such.csv": "tool.profile_file: /no/such.csv: cannot be read (no such file); check the path",
        "profile=polygon; tip_radius=0.1; part_radius=1e-3": "tool.tip_radius: the form is hollow with a radius of ",
        "profile=polygon; polygon_corner_radius=1.0": "tool.polygon_corner_radius: polygon: corner radius 1 m;",
        "profile=harmonics; harmonic_order=[2]": "...: harmonic profile: 1 orders, 0 amplitudes and 1 phases; giv",
    },
    "piston spindle_encoder": {
        "sample_rate=65536": "...sample_rate = 65536 Hz: its step ... allowed nearby: 64000 or 78125 Hz",
        "revolutions=0": "spindle_encoder.revolutions = 0; this run needs an end: allowed above 0",
        "deviation_amplitude=[0.1]; deviation_frequency=[1, 2]": "...: 1 amplitudes, 2 frequencies and 1 phases; give",
        "deviation_amplitude=[-1.5]": "...its deviations: spindle speed falls to -52.36 rad/s; allowed: above 0",
        "revolutions=1e30": "spindle_encoder.revolutions = 1e+30, nominal_rpm and its deviations: that takes up to ",
        "faults=['second 1e300: encoder.angle stuck']": "spindle_encoder.faults = 'second 1e300: fault encoder.angle ",
        "tachogram_time=[2, 1]; tachogram_deviation=[0.1, 0.1]": "...: times must start at 0 s or later and increase",
        "tachogram_time=[1.0]": "...: 1 times and 0 deviations; give as many of each",
        "random_rms=0.01; random_low=90": "spindle_encoder.random_low, random_high: random deviation: band 90-60 rad/",
    },
    "piston recorder": {"triggers=[melt]": "recorder.triggers = 'melt'; allowed: a pattern"},
    "vibration vibration": {"line_frequency=[1e9]; line_amplitude=[1e-6]": "vibration.line_frequency: vibration at "},
    "one_channel spindle_encoder": {"sample_rate=1000; nominal_rpm=15384": "...: a revolution takes 3.9 samples at "},
    "oval3000 controller": {
        "model_denominator=[1e-3, 1e-6]; model_numerator=[1e-5, 1e-8]": "... 2 and 2 coefficients; allowed: 4 and 2, ",
        "model_denominator=[1e-3, 1e-6, 1e-10, 1e-14]; model_numerator=[1e-7, 1e-8]": "... zeros that are not damped",
    },
    "robust disturbance_controller": {"height_from=slide": "disturbance_controller.height_from = slide; allowed: feed"},
    "robust spindle_encoder": {
        "reads_per_sample=4; edge_clock=1e-6": "spindle_encoder.reads_per_sample = 4 with edge_clock = 1e-06 s;",
        "edge_clock=1e-13": "spindle_encoder.edge_clock = 1e-13 s; allowed: 0, or from 1e-12 s up to 1 s",
    },
    "approach feed_drive": {
        "stop_time=1e300": "feed_drive.stop_time = 1e+300 [s] (default 1): ...; take what a machine has",
        "pitch_slope=1": "feed_drive.pitch_slope, pitch_amplitude, pitch_lead: screw: pitch error of 1 m/m and 0 m ",
        "friction=lugre; model=fourth_order": "feed_drive.friction = lugre with model = fourth_order, whose mechanics ",
        "friction=lugre; friction_static=1": "feed_drive.friction_coulomb, friction_static: friction: 1 N at rest and ",
    },
    "force_turning force_controller": {
        "set_point_time=[1, 0]; set_point=[1, 2]": "force_controller.set_point_time: [1.0, 0.0] s; allowed: one time ",
    },
    "approach position_controller": {
        "trajectory=csv": "position_controller.trajectory_file is empty; name the CSV file of the trajectory",
        "set_point=[1, 2]": "position_controller.set_point, set_point_time: 2 values and 1 times; give as many of each",
        "set_point_time=[1, 1]; set_point=[1, 2]": "position_controller.set_point_time: [1.0, 1.0] s; ... each later ",
        "feed_drive.model=dc_screw; feed_drive.zero=0.1": "feed_drive.velocity_gain, lags, zero: feed drive ",
        "law=periodic_hyperstable; period=0.0001": "position_controller.period, memory_filter, divisor: period of",
        "predistortion_file=/nowhere.csv": "position_controller.predistortion_file: /nowhere.csv: cannot be read",
        "link=paper; link_gain=20": "position_controller.link_gain, link_lag, divisor, feedback_delay, link: sampled",
    },
    "force_turning cutting_process": {
        "gap_start=[1.0]": "cutting_process.gap_start, gap_width: 1 and 0; give as many of each",
        "hard_spot_start=[1.0]": "cutting_process.hard_spot_start, ...: of lengths [1, 0, 0, 0, 0]; give as many of",
        "moved_by=[longitudinal, longitudinal]": "cutting_process.moved_by = ...; allowed: each once",
        "allowance_rate=1e-6": "cutting_process.allowance_rms and allowance_rate are both given; allowed: one of them",
        "run_out_amplitude=[]": "cutting_process.run_out_order, run_out_amplitude, run_out_phase: run-out: 1 orders, 0",
    },
    "full_cell decoupler": {
        "w1_numerator=[1, 1]; w1_denominator=[1]": "decoupler.w1_numerator, w1_denominator: transfer function [1.0, 1",
    },
    "full_cell spindle_encoder": {"block_size=128": "force_controller: ... delayed by 64 samples, block_size = 128;"},
    "two_channel tool": {"drives=[coarse, finest]": "tool reads finest/state, which no node of the scenario publishes"},
    "two_channel piezo_actuator": {
        "use_command=false": "piezo_actuator.use_command, use_reference, compensates: there is no set point; allowed",
        "compensates=[a, b, a]": "piezo_actuator.compensates = ['a', 'b', 'a']; allowed: each displacement once",
        "play_thresholds=[0.1]": "piezo_actuator.play_thresholds, play_weights, play_proportional: plays: 1 ",
        "play_thresholds=[0.2, 0.1]; play_weights=[0.1, 0.1]": "...: play thresholds [0.2, 0.1]; allowed: above 0 and ",
        f"play_proportional=0.1; play_weights={[-0.02] * 10}": "...: play weights: slope 0 after 5 plays; allowed",
        "hysteresis=bouc_wen; bouc_wen_a=0.8": "piezo_actuator.bouc_wen_a, bouc_wen_beta, bouc_wen_gamma: Bouc-Wen A",
        "identified_thresholds=[0.1]": "piezo_actuator.identified_weights: empty",
        "identified_weights=[0.1]": "piezo_actuator.identified_thresholds, ...: plays: 10 thresholds and 1 weights",
        "amplifier_lag=1e-9": "piezo_actuator.amplifier_lag, creep_shortest: lag of 1e-09 s at a step of ",
        "events=['revolution 3: freeze']": "piezo_actuator.events: event 'freeze'",
    },
    "series series_drive": {
        "fine_damping=-1": "series_drive.fine_damping = -1; allowed: a finite number above 0",
        "fine_use_command=false": "series_drive.fine_use_command, fine_use_reference, fine_compensates: there is no ",
        "fine_compensates=[a, a]": "series_drive.fine_compensates = ['a', 'a']; allowed: each displacement once",
        "fine_play_thresholds=[0.1]": "series_drive.fine_play_thresholds, ...: plays: 1 thresholds and 10 weights",
        "fine_use_command=false; fine_use_reference=true; fine_compensates=[coarse]; mass_ratio=1; sample_rate=4000":
            "series_drive.mass_ratio, sample_rate: series drive: at a step of ",
    },
    "gauged profile": {
        "tool.remap=['coarse/state:=gauge/state']; harmonic_amplitude=[0.0, 2e-3, 0.0, 0.0]":
            "profile.profile: loaded_drive cannot follow it ... stroke",
    },
    "gauged gauge": {
        "points_per_revolution=100": "gauge.points_per_revolution = 100; allowed: a power of 2",
        "points_per_revolution=4096": "gauge.points_per_revolution = 4096: ... 2048 or fewer, or a sample_rate of ",
        "gap_start=[1.0]": "gauge.gap_start, gap_width: 1 and 0; give as many of each",
        "cutoff=1000": "gauge.cutoff = 1000 UPR; allowed: 5 up to 64 with 512 points",
        "angle_offset=0.2": "gauge.angle_offset = 0.2 rad: the correction diverges; allowed: less than 0.00615 rad, ",
        "dropouts_per_revolution=1e4": "gauge.dropouts_per_revolution = 10000; allowed: below 3840",
        "tool_delay=4096": "gauge.tool_delay = 4096 samples: ... allowed: a shorter delay, or more revolutions_late",
        "tool_delay=8": "gauge: feedback of encoder is delayed by 8 samples, block_size = 16",
    },
    "robust_cutting loaded_drive": {
        "coarse_loop=current; coarse_bandwidth=500e3": "...: current loop of 500000 rad/s at a step of ...: largest p",
        "coarse_current_limit=3": "loaded_drive.coarse_current_limit = 3 with coarse_loop = ideal; allowed: 0, or curr",
        "cut_gap_start=[1, 2]": "loaded_drive.cut_gap_start, cut_gap_width: 2 and 3; give as many of each",
        "coarse_lag_time=[1e-3]; coarse_lag_participation=[0.1]":
            "...: mode_velocity and lag_time say how the drive follows its command, not how it gives way to a force; ",
        "coarse_mode_frequency=[5e3]; coarse_mode_damping=[0.1]; coarse_mode_participation=[0.1]; coarse_loop=current":
            "...: modes belong to a closed position loop; allowed: without a current loop",
    },
    "supervised electrodynamic_actuator": {
        "gain=0.1": "learning_controller.retract_position = 3e-05 m, but the tool is out of the part beyond",
        "command_stroke=0.275e-3": "electrodynamic_actuator.command_stroke = 0.000275 m, but the tool is out of the",
    },
    "supervised learning_controller": {
        "retract_position=0": "learning_controller.retract_position = 0 m, but ...clear_position = 0.00028 m; allowed",
        "retract_position=2e-3; supervisor.clear_position=1.5e-3": "... of electrodynamic_actuator ends at 0.001 m;",
        "reaction_delay=3200; retract_time=0.01": "learning_controller.retract_time = 0.01 s: ... the stroke of ",
        "reaction_delay=0": "supervisor: monitor speed asks for stop, but no node that moves coarse reads safety;",
        "reaction_delay=32": "learning_controller: feedback of safety is delayed by 32 samples, block_size = 64",
        "publish_margin=false": "supervisor reads coarse/margin, which no node of the scenario publishes; allowed",
    },
    "supervised supervisor": {
        "following_limit=[1e-4, 2e-4]": "supervisor.following_limit = [0.0001, 0.0002]; allowed: one for each of",
        "margin_limit=[0.1, 0.1]": "supervisor.margin_limit = [0.1, 0.1]; allowed: one for each of coarse",
        "slide_limit=[1e-4]": "supervisor.slide_limit = [0.0001]; allowed: one for each of none",
        "speed_limit=-1": "supervisor.speed_limit = -1; allowed: a finite number from 0 [rad/s]",
        f"events=['revolution 12: retract']; drives=[]; {QUIET}; {ALONE}": "supervisor.events: event 'retract', and no",
        f"events=['revolution 12: retract']; learning_controller.reaction_delay=0; {QUIET}": "...asks for retract,",
    },
    "supervised_turning supervisor": {"force_reaction=retract": "supervisor.force_reaction = retract, but no drive is"},
    "interrupted_cut spindle_encoder": {
        f"allow_faults=true; faults=['second 1: {fault}']": f"spindle_encoder.faults: {said}" for fault, said in {
            "encoder.angle broken": "fault 'encoder.angle broken'; allowed: TARGET KIND NAME=VALUE ..., KIND one of",
            "encoder.angle noisy": f"fault 'encoder.angle noisy': no rms; {ALLOWED_RMS}",
            "encoder.angle noisy rms=-1": f"fault 'encoder.angle noisy rms=-1': rms=-1; {ALLOWED_RMS}",
            "encoder.angle noisy rms=nan": f"fault 'encoder.angle noisy rms=nan': rms=nan; {ALLOWED_RMS}",
            "encoder.angle noisy rms=1 rms=2": f"fault 'encoder.angle noisy rms=1 rms=2': rms=2; {ALLOWED_RMS}",
            "encoder.angle garbage amplitude=1e308": "...: amplitude=1e308; allowed: each once: amplitude= a number ",
            "encoder.angle stuck at=3": "fault 'encoder.angle stuck at=3': at=3; allowed: no values",
            "encoder.angle delayed time=1e9": "...: time=1e9; allowed: each once: time= a number above 0 below 10 [s]",
            "x" * 300: "a fault of 300 characters; allowed: up to 200",
            "encoder.index_pulse noisy rms=1": "...: no such target for it; allowed for noisy: encoder.angle, encoder.",
            "encoder stuck": "...encoder.index_pulse, encoder.speed; for encoder: missed_index, lost_counts, reversed",
            "encoder.angle_true stuck": "fault 'encoder.angle_true stuck': no such target for it; allowed for stuck:",
        }.items()
    },
    "interrupted_cut cutting_process": {
        f"allow_faults=true; faults=['second 1: {fault}']": f"cutting_process.faults: fault {said}" for fault, said in {
            "encoder reversed": "'encoder reversed': no such target for it; allowed for reversed: none of this node",
            "cut off": "'cut off': ... allowed for off: cut.allowance, cut.deflection, ...; for cut: tool_broken, hard",
            "cut.force tool_broken length=1": "...; allowed for tool_broken: cut; for cut.force: off, ",
        }.items()
    },
}  # fmt: skip


def by_python(name, changes, _):
    return line_of(lambda: harness.run(load(name, [f"{target}={value}" for target, value in changes.items()])))


def by_command(name, changes, _):
    sets = [word for target, value in changes.items() for word in ("--set", f"{target}={value}")]
    done = lathe("run", name, *sets)
    assert (done.exit_code, done.stdout, done.stderr[:7], done.stderr[-1:]) == (2, "", "lathe: ", "\n"), done.output
    return done.stderr[7:-1]


def by_file(name, changes, folder):
    nodes = yaml.safe_load(SCENARIOS[0].with_stem(name).read_text())
    for target, value in changes.items():
        node, _, parameter = f"/**.{target}".removeprefix("/**." if "." in target else "").rpartition(".")
        table = nodes.setdefault(f"/{node}".replace("//", "/"), {"ros__parameters": {}})
        table["ros__parameters"][parameter] = ros_yaml.parse_value(value, target)
    (folder / "cell.yaml").write_text(yaml.safe_dump(nodes, allow_unicode=True))
    return line_of(lambda: harness.run(load(folder / "cell.yaml")))


def by_panel(name, changes, _):
    cell = LiveCell(load(name))
    with Driver(cell, 0.0) as driver, pytest.raises(InputError) as refused:
        panel.site(driver, cell).answers["change"]({"values": changes})
    return str(refused.value)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where scenario files find the profiles; the handler of SIGTERM that a command installs is removed again."""
    folder, before = tmp_path_factory.mktemp("cell"), signal.getsignal(signal.SIGTERM)
    (folder / "profiles").symlink_to(SCENARIOS[0].with_name("profiles"))
    yield folder
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("door", [by_python, by_command, by_file, by_panel])
@pytest.mark.parametrize("place", REFUSED)
def test_a_cell_that_cannot_run_is_refused_in_one_line(place, door, folder):
    name, node = place.split()
    for row, said in REFUSED[place].items():
        given = dict(change.split("=", 1) for change in row.split("; "))
        changes = {key if "." in key or key in SHARED else f"{node}.{key}": value for key, value in given.items()}
        line = door(name, changes, folder)
        assert re.match(re.escape(said).replace(r"\.\.\.", ".*"), line), (row, line)
        assert "\n" not in line
