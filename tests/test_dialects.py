# SPDX-License-Identifier: Apache-2.0
"""Tables of other instruments: one file has the same numbers in every encoding and dialect, for every reader."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lathe_rc.cell import cells_file
from lathe_rc.signals import measured_profile, measurement_file, tachogram
from lathe_rc.signals.counts import CsvReader

TEXTS = {
    "tachogram": "# of a µ-tachometer\ntime_s,rpm\n1700000000.25,999.5\n1700000000.5,1000.25\n1700000001,1001\n",
    "counts": "# at 20 °C\ntime_s,counts,edge_s,index_counts\n0.001,5,0.0005,\n0.0025,-3,0.002,4.5\n",
    "profile": "# Ø 100\nangle_deg,radius_um\n0,1.5\n120,-2.25\n240,0.75\n",
    "measurement": "time_ms,command [µm],response\n# µ\n0,1.5,2e-6\n0.5,-1e-3,0.25\n",
    "cells": "tool.tolerance,learning_controller.lead_time\n2e-6,0.0012\n1,1.4e-3\n",
    "whole numbers first": "time_ms,command [µm],response\n0,1,2\n1,0.5,0.25\n",
}


def columns(path):
    found = measurement_file.read(path, {})
    return [np.asarray(found.read(name)[0]) for name in ("time", "command", "response")]


def counted(path):
    reader = CsvReader(path)
    return [*reader.read(), *reader.pulses, reader.numbers]


READERS = {
    "tachogram": tachogram.read,
    "counts": counted,
    "profile": lambda path: [(form := measured_profile.read_csv(path)).angle, form.radius],
    "measurement": columns,
    "whole numbers first": columns,
    "cells": lambda path: [[*cell.values()] for cell in cells_file.read(path)],
}
DIALECTS = {
    "decimal comma": lambda text: text.replace(",", ";").replace(".", ",").encode(),
    "semicolon, decimal point": lambda text: text.replace(",", ";").encode(),
    "tabulator, CRLF": lambda text: text.replace(",", "\t").replace("\n", "\r\n").encode(),
    "UTF-8 with a mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "Windows-1252, decimal comma": lambda text: text.replace(",", ";").replace(".", ",").encode("cp1252"),
}


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_table_has_the_same_numbers_in_every_dialect(tmp_path, kind, dialect):
    plain, other = tmp_path / "plain.csv", tmp_path / "other.csv"
    plain.write_text(TEXTS[kind], encoding="utf-8")
    other.write_bytes(DIALECTS[dialect](TEXTS[kind]))
    wanted, found = READERS[kind](plain), READERS[kind](other)
    for one, same in zip(wanted, found, strict=True):
        assert_array_equal(one, same)
