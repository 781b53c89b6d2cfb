# SPDX-License-Identifier: Apache-2.0
"""The desired form under the tool as a node of its own, for drives that need it before the tool computes."""

from lathe_rc import messages
from lathe_rc.cell.stage import DONE, Fields, Joint, Output, Reached, Stage
from lathe_rc.cell.stages.form import Form, FormParameters, FormTable, evaluate
from lathe_rc.jit import kernel


@kernel
def step(memory: FormTable, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """See `lathe_rc.cell.stage`."""
    reference, expected, height = outputs
    evaluate(memory, inputs, reference, expected, height)
    return height.size, DONE


class ProfileStage(Stage):
    """Evaluates the form at the spindle angle and the height.

    Attributes:
        parameters: its table.
        form: of the part.
    """

    kind = "profile"
    Parameters = FormParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: FormParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.form = Form(name, parameters)
        self.declare(
            inputs=self.form.inputs,
            outputs=[Output("reference", messages.REFERENCE, Joint("reference"))],
        )

    def warnings(self, seconds: float) -> list[str]:
        """See `Stage`."""
        return self.form.doubts

    @property
    def memory(self) -> FormTable:
        """See `Stage`."""
        return self.form.table
