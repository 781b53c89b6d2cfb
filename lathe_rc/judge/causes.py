# SPDX-License-Identifier: Apache-2.0
"""Causes of a form error by name, with the parameter values that switch each off."""

from collections.abc import Mapping

from lathe_rc.cell.parameters import Values

PREFIXES = ("", "coarse_", "fine_", "cut_")  #: parameter prefixes of stages composed of several devices

#: causes in the order of a budget, and the values that switch each off in every node that has these parameters; tables
#: may have values of their own, and causes that come behind these (`NodeParameters.causes`)
EVERYWHERE: Mapping[str, Values] = {
    "force": {"deflects": False, "cross_slide": False, "radial_ratio": 0.0},
    "load": {},
    "vibration": {},
    "error motion": {"error_motion_order": [], "error_motion_amplitude": [], "error_motion_phase": []},
    "drift": {"gain_drift": 0.0, "mode_drift": 0.0},
    "noise": {"noise_rms": 0.0},
    "jitter": {"sampling_jitter": 0.0},
    "quantisation": {"counts_per_revolution": 0, "resolution": 0.0, "adc_step": 0.0, "dac_step": 0.0},
    "hysteresis": {"hysteresis": "none", "linearisation": "none", "creep_per_decade": 0.0},
    "backlash": {"backlash": 0.0},
    "limits": {f"command_{name}": 0.0 for name in ("stroke", "velocity", "acceleration", "jerk")}
    | {f"{name}_limit": 0.0 for name in ("current", "voltage", "torque")}
    | {"slew_rate": 0.0},
    "faults": {"faults": []},
}
#: causes that make one revolution differ from the next
_CHANGING: Mapping[str, Values] = {
    "drift": EVERYWHERE["drift"],
    "noise": EVERYWHERE["noise"],
    "jitter": EVERYWHERE["jitter"],
    "quantisation": EVERYWHERE["quantisation"],
    "vibration": {"random_rms": 0.0, "line_amplitude": []},
}
_CONSTANT = ("harmonics", "polygon")  # profiles that are constant along the part


def changing(nodes: Mapping[str, Values]) -> list[str]:
    """Return the names of the causes that make revolutions differ from each other, except for speed and cut.

    Args:
        nodes: all values by node and parameter, unchecked; empty lists may be omitted.
    """
    found = [
        name
        for name, off in _CHANGING.items()
        if any(
            values.get(f"{prefix}{each}", none) != none
            for values in nodes.values()
            for prefix in PREFIXES
            for each, none in off.items()
        )
    ]
    fed = any(
        values.get("profile", _CONSTANT[0]) not in _CONSTANT
        and (values.get("feed", 0.0) != 0.0 or values.get("height_from") == "slide")
        for values in nodes.values()
    )
    return [*found, *(["feed"] if fed else [])]
