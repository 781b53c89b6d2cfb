# SPDX-License-Identifier: Apache-2.0
# The public face of lathe_rc, and the only list of it: `lathe_rc.public` imports from here. Other modules may change.

from lathe_rc import messages as messages
from lathe_rc import study as study
from lathe_rc.bag.reader import read_bag as read_bag
from lathe_rc.blocks.ports import Input as Input
from lathe_rc.blocks.ports import Output as Output
from lathe_rc.cell.batch import run_many as run_many
from lathe_rc.cell.parameters import NodeParameters as NodeParameters
from lathe_rc.cell.parameters import parameter as parameter
from lathe_rc.cell.recording import Recording as Recording
from lathe_rc.cell.scenario import Scenario as Scenario
from lathe_rc.cell.scenario import load as load
from lathe_rc.cell.stage import DONE as DONE
from lathe_rc.cell.stage import Stage as Stage
from lathe_rc.errors import InputError as InputError
from lathe_rc.errors import LatheError as LatheError
from lathe_rc.harness.result import Result as Result
from lathe_rc.harness.runner import run as run
from lathe_rc.jit import kernel as kernel
from lathe_rc.judge.budget import budget as budget
from lathe_rc.view.report import write_report as write_report

__version__: str
