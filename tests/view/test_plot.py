# SPDX-License-Identifier: Apache-2.0
"""The plot at the end of ``lathe run``, which appears only in a terminal."""

import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from bags import lathe
from cells import run
from rich.console import Console

from lathe_rc.commands import plot, tables

COMMAND = [sys.executable, "-m", "lathe_rc", "run", "piston", "--revolutions", "4"]
HEADING = "form error [µm] by revolution"
COLOUR = "\x1b[96m"  # of the RMS


def in_terminal(width, **environment):
    """Return the output of the command in a terminal that is ``width`` characters wide."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    own = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    own |= {"TERM": "xterm-256color", "PYTHONIOENCODING": "utf-8", **environment}
    with subprocess.Popen(COMMAND, stdout=theirs, stderr=subprocess.DEVNULL, env=own) as process:
        os.close(theirs)
        text = b""
        try:
            while piece := os.read(ours, 65536):
                text += piece
        except OSError:  # the other end is closed
            pass
        os.close(ours)
    assert process.returncode == 0
    return text.decode()


def test_the_plot_is_as_wide_as_the_terminal_and_honours_no_color():
    lines = in_terminal(width=70, NO_COLOR="1").splitlines()
    top = next(k for k, line in enumerate(lines) if line.startswith(HEADING))
    assert "tolerance 2 µm" in lines[top]
    frame = [line for line in lines[top + 1 :] if re.match(r" *[┌└]", line)]
    assert [len(line.rstrip()) for line in frame] == [70, 70]
    assert [int(number) for number in re.findall(r"\d+", lines[lines.index(frame[1]) + 1])] == [1, 2, 3, 4]
    assert any(re.search("[⠁-⣿]", line) for line in lines[top:])
    assert COLOUR not in "".join(lines)


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("kind", "width", "drawn"), [("xterm", 80, True), ("dumb", 80, False), ("xterm", 30, False)])
def test_a_terminal_that_cannot_show_it_gets_none(kind, width, drawn):
    """A dumb or a narrow terminal gets no plot; others get it in colours."""
    console = Console(file=Terminal(), width=width, _environ={"TERM": kind})
    console.print(*plot.shown(run(), console))
    assert (HEADING in console.file.getvalue()) == (COLOUR in console.file.getvalue()) == drawn


def test_neither_a_pipe_nor_json_has_it(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert HEADING not in lathe(*COMMAND[3:]).stdout
    monkeypatch.setattr(plot, "shown", None)
    assert lathe(*COMMAND[3:], "--json").stdout.startswith("{"), "also in a terminal"


def test_the_curves_are_where_the_errors_are():
    """The axis spans the decades of the errors, and no peak of a long run is lost when its points are thinned."""
    result = run(spindle_encoder={"revolutions": 40.0}, tool={"tolerance": 2e-6})
    console = Console(width=60, force_terminal=True, color_system=None)
    with console.capture() as caught:
        console.print(plot.drawn(result, 60))
    ticks = [float(tick) for tick in re.findall(r"(?m)^ *([\d.]+)┤", caught.get())]
    assert ticks == sorted(ticks, reverse=True)
    assert ticks[0] >= result.errors.largest.max() * 1e6 > ticks[0] / 10
    assert ticks[-1] <= result.errors.rms.min() * 1e6 < ticks[-1] * 10


def test_one_revolution_is_no_curve():
    assert plot.drawn(run(spindle_encoder={"revolutions": 1.2}), 80) is None


def test_errors_of_0_have_no_logarithm_to_plot():
    perfect = run()
    perfect.errors.rms[:] = 0.0
    assert plot.drawn(perfect, 80) is None


@pytest.mark.parametrize(("tolerance", "above"), [(2e-6, True), (5e-7, False)])
def test_the_tolerance_is_drawn_on_its_side_of_a_power_of_ten(tolerance, above):
    """2 µm was drawn on the line of 1 µm."""
    lines = str(plot.drawn(run(tool={"tolerance": tolerance}), 80)).splitlines()
    drawn = next(k for k, line in enumerate(lines) if len(re.findall("[⠁-⣿]", line)) > 60)
    label = next(k for k, line in enumerate(lines) if line.lstrip().startswith("1┤"))
    assert (drawn < label) == above
    assert drawn != label


def test_a_pipe_cuts_no_column_of_any_command(monkeypatch, capsys):
    monkeypatch.delenv("COLUMNS", raising=False)
    names = ["first" * 12, "second" * 12]
    table = tables.table(*names)
    table.add_row(*names)
    tables.console().print(table)
    told = capsys.readouterr().out
    assert [told.count(name) for name in names] == [2, 2]
    others = [path.name for path in Path(tables.__file__).parent.glob("*.py") if "Console()" in path.read_text()]
    assert not others, "each command prints with tables.console"


def test_lines_of_a_result_stay_whole_and_its_tables_fit(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    path = "folder/" * 10
    tables.show({}, [path, tables.table("first" * 12)], as_json=False)
    line, *table = capsys.readouterr().out.splitlines()
    assert line == path
    assert max(map(len, table)) <= 40


def test_headings_that_do_not_fit_break_after_dots_and_underscores():
    names = ["cell", "learning_controller.lead_time", "tool.max_error"]
    assert tables.broken(names, 80) == names
    told = tables.broken(names, 40)
    assert told == ["cell", "learning_\ncontroller.\nlead_time", "tool.max_\nerror"]
    assert [name.replace("\n", "") for name in told] == names
