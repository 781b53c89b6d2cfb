# SPDX-License-Identifier: Apache-2.0
"""The studies by name. Each module holds one `Study`; list it here."""

from typing import Any

from lathe_rc.extensions import Objects
from lathe_rc.studies import (
    angle_domain,
    best_law,
    coupling,
    decoupling,
    drive_models,
    drive_tolerance,
    invariance,
    multichannel,
    piston,
    robust,
    sampled_servo,
    saturation,
    sensor_map,
    speed_deviation,
)
from lathe_rc.studies.study import Study

_OWN: dict[str, Study[Any]] = {
    module.STUDY.name: module.STUDY
    for module in (
        invariance,
        speed_deviation,
        sensor_map,
        robust,
        best_law,
        multichannel,
        piston,
        angle_domain,
        drive_models,
        saturation,
        sampled_servo,
        decoupling,
        drive_tolerance,
        coupling,
    )
}

#: by name, ours and those of other packages
STUDIES: Objects[Study[Any]] = Objects("study", Study, _OWN, "lathe_rc.studies")
