# SPDX-License-Identifier: Apache-2.0

from lathe_rc.studies.catalogue import STUDIES as STUDIES
from lathe_rc.studies.study import Study as Study
from lathe_rc.studies.study import StudyParameters as StudyParameters
from lathe_rc.studies.study import Track as Track
from lathe_rc.studies.study import comparison as comparison
from lathe_rc.studies.study import untracked as untracked
