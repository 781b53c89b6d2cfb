# SPDX-License-Identifier: Apache-2.0
# The public face of lathe_machine, and the only list of it; some modules of its subpackages are public as well.

from lathe_machine.stages.drive.plant import Plant as Plant
from lathe_machine.stages.drive.plant import PlantParameters as PlantParameters
from lathe_machine.stages.learning.law import Law as Law
from lathe_machine.stages.learning.law import Now as Now
from lathe_machine.stages.learning.learner import LawParameters as LawParameters
