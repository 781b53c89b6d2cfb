# SPDX-License-Identifier: Apache-2.0
"""Prints docs/faults.md, one run for each fault, or with --static the tables of safety.md: kinds, states, reactions."""

import sys

import numpy as np

import lathe_rc
from lathe_rc import messages
from lathe_rc.safety.faults import KINDS
from lathe_rc.safety.state_machine import MEANING, Reaction, State, table
from place import CONFIG

SPINDLE = [
    "encoder.angle off",
    "encoder.angle stuck",
    "encoder.angle garbage amplitude=100",
    "encoder.angle wrong scale=1.001",
    "encoder.speed wrong scale=1.2",
    "encoder.angle slow time=0.01",
    "encoder.angle delayed time=0.005",
    "encoder.speed intermittent good=0.01 off=0.001",
    "encoder.angle noisy rms=1e-4",
    "encoder missed_index",
    "encoder lost_counts angle=0.01",
    "encoder reversed",
]
ERROR = [
    "tool.measured_error off",
    "tool.measured_error stuck",
    "tool.measured_error garbage amplitude=1e-4",
    "tool.measured_error wrong scale=-1",
    "tool.measured_error slow time=0.001",
    "tool.measured_error delayed time=0.01",
    "tool.measured_error intermittent good=0.01 off=0.001",
    "tool.measured_error noisy rms=2e-6",
]


def drive(channel: str) -> list[str]:
    """Faults of a drive of the tool."""
    told = [
        "command.position off",
        "command.position stuck",
        "command.position garbage amplitude=1e-4",
        "command.position wrong scale=0.9",
        "command.position slow time=0.001",
        "command.position delayed time=0.002",
        "command.position intermittent good=0.01 off=0.001",
        "command.position noisy rms=1e-5",
        "state.position stuck",
        "state.measured_position off",
        "state.measured_position stuck",
        "state.measured_position garbage amplitude=1e-4",
        "state.measured_position wrong scale=0.9 offset=1e-5",
        "state.measured_position slow time=0.001",
        "state.measured_position delayed time=0.002",
        "state.measured_position intermittent good=0.01 off=0.001",
        "state.measured_position noisy rms=1e-5",
    ]
    return [f"{channel}/{fault}" for fault in told]


PISTON = {"spindle_encoder": SPINDLE, "learning_controller": ERROR, "electrodynamic_actuator": drive("coarse")}
CUT = [
    "cut tool_broken length=1e-3",
    "cut hard_spot factor=2",
    "cut.measured_force off",
    "cut.measured_force stuck",
    "cut.measured_force garbage amplitude=300",
    "cut.measured_force wrong scale=0.8",
    "cut.measured_force slow time=0.1",
    "cut.measured_force delayed time=0.1",
    "cut.measured_force intermittent good=0.1 off=0.01",
    "cut.measured_force noisy rms=10",
]
FEED = [
    "longitudinal/command.command off",
    "longitudinal/command.command stuck",
    "longitudinal/command.command noisy rms=0.1",
    "longitudinal/state.velocity off",
    "longitudinal/state.measured_position stuck",
]
#: scenario, revolution of the fault, and the faults by node
CASES = {
    "supervised": (60, PISTON),
    "supervised_two_channel": (100, PISTON | {"fine_controller": ERROR, "piezo_actuator": drive("fine")}),
    "supervised_turning": (200, {"spindle_encoder": SPINDLE, "cutting_process": CUT, "longitudinal": FEED}),
}


def kinds() -> list[str]:
    """The table of the kinds of faults."""
    lines = ["| kind | of | effect on the signal | values |", "| --- | --- | --- | --- |"]
    for name, kind in KINDS.items():
        values = []
        for key, value in kind.values.items():
            unit = {"": "unit of the signal", "1": ""}.get(value.unit, value.unit)
            default = "" if value.default is None else f" ({value.default:.4g})"
            values.append(f"`{key}`{default}: {value.doc}{f' [{unit}]' if unit else ''}")
        of = {"field": "any field", "encoder": "the encoder", "cut": "the cut"}[kind.what]
        lines.append(f"| `{name}` | {of} | {kind.doc} | {'; '.join(values)} |")
    return lines


def states() -> list[str]:
    """The table of the states and what leads from one to another."""
    lines = [f"| cause | {' | '.join(f'in {state.name.lower()}' for state in State)} |", "| --- |" + " --- |" * 4]
    lines += [f"| {' | '.join(row)} |" for row in table()]
    lines += ["", "| reaction | effect |", "| --- | --- |"]
    return lines + [f"| {reaction.name.lower()} | {said} |" for reaction, said in MEANING.items()]


def noticed(name: str, node: str, fault: str, revolution: int) -> tuple[str, int]:
    """The row of a fault, from one run, and the number of samples that the run lost."""
    overrides = [f"{node}.faults=['revolution {revolution}: {fault}']"]
    result = lathe_rc.run(lathe_rc.load(CONFIG / f"{name}.yaml", overrides))
    recording = result.recording
    lost = sum(result.samples - next(iter(signals.values())).size for signals in recording.dense.values())
    events = recording.sparse[f"/{node}/events"].values
    begin = events["sample_index"][events["action"].index(f"fault {fault}")]
    status = recording.sparse["/safety/status"].values
    found = list(zip(status["sample_index"], status["state"], strict=True)) if status else []
    safe = next((index for index, state in found if state == State.SAFE), None)
    # The error is positive where the tool is too deep in the part.
    tools = [signals["error"] for topic, signals in recording.dense.items() if recording.types[topic] == messages.TOOL]
    depth = [f"{error[begin:safe].max() * 1e6:.3g}" for error in tools]
    row = [f"`{fault}` at {node}"]
    if not status:
        return f"| {' | '.join([*row, 'not noticed', '', '', *depth])} |", lost
    angle = recording.of_type(messages.ENCODER)["angle_true"]
    first, step = found[0][0], 1.0 / 64000
    by = (
        f"{status['monitor'][0]}, {(first - begin) * step * 1e3:.3g}, {(angle[first] - angle[begin]) / (2 * np.pi):.3g}"
    )
    end = State(status["state"][-1]).name.lower()
    after = end if safe is None else f"{end} after {(safe - begin) * step * 1e3:.3g} ms"
    return f"| {' | '.join([*row, by, Reaction(max(status['reaction'])).name.lower(), after, *depth])} |", lost


HEAD = """\
# Every fault, and its reaction

`./lathe python figures/safety.py` prints this page; each row is one run. Each fault begins at the given revolution and
is permanent. "Too deep by" is the largest form error into the part between the fault and the safe state, or the end of
the run. [safety.md](safety.md) gives the definitions and limits.
"""


def main() -> None:
    """Print the page, or with ``--static`` the tables that need no run."""
    if "--static" in sys.argv:
        print("\n".join([*kinds(), "", *states()]))
        return
    print(HEAD)
    missing = 0
    for name, (revolution, faults) in CASES.items():
        # The cell of force-controlled turning has no tool that follows a form.
        depth = "" if name == "supervised_turning" else " too deep by [µm] |"
        print(f"## {name}\n\nFault at revolution {revolution}.\n")
        print(f"| fault | noticed by, after [ms, rev] | reaction | state at the end |{depth}")
        print(f"| --- | --- | --- | --- |{' ---: |' if depth else ''}")
        for node, texts in faults.items():
            for fault in texts:
                row, lost = noticed(name, node, fault, revolution)
                print(row)
                missing += lost
        print()
    print(f"Samples lost in all runs together: {missing}.")


main()
