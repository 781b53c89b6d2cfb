# SPDX-License-Identifier: Apache-2.0
"""Studies: tables and figures of the papers, computed anew. Each module holds one `Study`; list it here."""

from typing import Any

from lathe_rc.studies import angle_domain, drive_models, invariance, speed_deviation
from lathe_rc.studies.study import Study

STUDIES: dict[str, Study[Any]] = {
    study.name: study for study in (invariance.STUDY, angle_domain.STUDY, drive_models.STUDY, speed_deviation.STUDY)
}
