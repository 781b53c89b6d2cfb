# SPDX-License-Identifier: Apache-2.0
"""The completion scripts, read by their shells."""

import subprocess

import pytest
from click.testing import CliRunner

from lathe_rc.commands.completion import completion

pytestmark = pytest.mark.system


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_can_be_read_by_their_shells(shell):
    printed = CliRunner().invoke(completion, [shell]).output
    subprocess.run([shell, "-n"], input=printed, text=True, check=True)
