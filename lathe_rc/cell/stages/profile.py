# SPDX-License-Identifier: Apache-2.0
"""The desired form under the tool as a node of its own, for drives that need it before the tool computes."""

from collections.abc import Sequence

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.stage import Joint, Output, Sparse, Stage
from lathe_rc.cell.stages.form import Form, FormParameters


class ProfileStage(Stage):
    """Evaluates the form at the spindle angle and the height.

    Attributes:
        parameters: its table.
        form: of the part.
    """

    kind = "profile"
    Parameters = FormParameters

    def __init__(self, name: str, parameters: FormParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.form = Form(name, parameters)
        self.declare(
            inputs=self.form.inputs,
            outputs=[Output("reference", messages.REFERENCE, Joint("reference"))],
        )

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        (part,) = outputs
        self.form.block(inputs, part["reference"], part["expected"], part["height"])
        return []
