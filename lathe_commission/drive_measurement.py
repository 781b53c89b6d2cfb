# SPDX-License-Identifier: Apache-2.0
"""Measurement of a drive as data of `lathe_commission.modal_fit`: by its quantities a response, a record or a step."""

import numpy as np

from lathe_commission.modal_fit import ResponseData, StepData
from lathe_rc.analysis.frequency_response import FrequencyResponse, Hold, estimate, of_measurement
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.signals.measurement_file import MeasuredQuantities

_LEVEL = 1e-9  # of the height of a step, within which a command is constant


def frequency_response(
    measurement: MeasuredQuantities,
    *,
    rate: float | None = None,
    hold: Hold = "linear",
    resolution: float | None = None,
    averages: float | None = None,
    highest: float | None = None,
) -> FrequencyResponse | None:
    """Return the frequency response that a measurement has or shows; None for a step.

    Args:
        measurement: quantities of the measurement.
        rate: sampling frequency of a record [Hz]; None: that of its time.
        hold: course of a record's command between its samples (`lathe_rc.analysis.frequency_response.estimate`).
        resolution: distance of the bins of a record [Hz]; None: chosen.
        averages: number of averages of a coherence in the measurement; None: 16.
        highest: highest frequency of a record [rad/s]; None: 0.2 of its sampling frequency.

    Raises:
        InputError: the quantities are those of no measurement, or unusable.
    """
    if "frequency" in measurement:
        return of_measurement(measurement, averages)
    if "command" not in measurement or "response" not in measurement:
        if "response" in measurement and "time" in measurement:
            return None
        raise measurement.lacking(
            "time and response of a step of 1, command and response, or frequency with magnitude and phase"
        )
    command, response = measurement.read("command", "response")
    if _change(command):
        return None
    step = measurement.clock(rate, "command", "response").step
    try:
        return estimate(command, response, step, hold=hold, resolution=resolution, highest=highest)
    except InputError as error:
        raise InputError(f"{measurement.name}: {error}") from None


def _change(command: Array) -> int:
    """Return the first sample after a command's only change; 0 if it changes never or more than once."""
    tolerance = _LEVEL * float(np.ptp(command)) if command.size else 0.0
    changes = np.flatnonzero(np.abs(np.diff(command)) > tolerance)
    return int(changes[0]) + 1 if changes.size == 1 else 0


def step_response(measurement: MeasuredQuantities, *, rate: float | None = None, hold: Hold = "linear") -> StepData:
    """Return the response to a step of 1 at time 0.

    A record whose command changes once is divided by that change; the time begins in the middle of the sample before
    it, on average, unless the command is held (``zero``).

    Raises:
        InputError: the record is no step response.
    """
    try:
        if "command" not in measurement:
            time, response = measurement.read("time", "response")
            return StepData(time, response)
        command, response = measurement.read("command", "response")
        first, step = _change(command), measurement.clock(rate, "command", "response").step
        height = float(command[-1] - command[0])
        time = np.asarray((np.arange(response.size - first) + (0.0 if hold == "zero" else 0.5)) * step, np.float64)
        return StepData(time, (response[first:] - float(np.mean(response[:first]))) / height)
    except InputError as error:
        raise InputError(f"{measurement.name}: {error}") from None


def data(
    measurement: MeasuredQuantities,
    *,
    rate: float | None = None,
    hold: Hold = "linear",
    resolution: float | None = None,
    averages: float | None = None,
    band: tuple[float, float] | None = None,
) -> ResponseData | StepData:
    """Return a measurement as data of a fit; ``band`` in rad/s, the others as for `frequency_response`.

    Raises:
        InputError: the measurement is unusable, or an option does not apply to its kind.
    """
    highest = band[1] if band else None
    if "frequency" in measurement:
        _refuse(measurement, "a frequency response", rate=rate, resolution=resolution)
    response = frequency_response(
        measurement, rate=rate, hold=hold, resolution=resolution, averages=averages, highest=highest
    )
    if response is None:
        _refuse(measurement, "a step response", resolution=resolution, averages=averages, band=band)
        if "command" not in measurement:
            _refuse(measurement, "a step response with times", rate=rate)
        return step_response(measurement, rate=rate, hold=hold)
    if "frequency" not in measurement:
        _refuse(measurement, "a record", averages=averages)
    try:
        return ResponseData(response.within(*band) if band else response)
    except InputError as error:
        raise InputError(f"{measurement.name}: --band: {error}") from None


def _refuse(measurement: MeasuredQuantities, kind: str, **options: object) -> None:
    """Reject options that a kind of measurement would ignore."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{measurement.name}: --{name} does not apply to {kind}; leave it out")
