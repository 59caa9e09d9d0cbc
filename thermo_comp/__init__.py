# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Thermal-drift compensation of a three-axis accelerometer, after Golovach (2016).

    import thermo_comp as tc

    cal = tc.load('unit42.yaml')
    out = cal.correct(time_s, counts, board=board, case=case)
    out.specific_force, out.covariance, out.dynamic

This module owns the public names, and states the conventions of all other docstrings.

Units
    SI and degrees Celsius. Temperature differences and rates are in K and K/s. A name carries a
    unit suffix only where there is no docstring to read (file keys, ROS parameters, command-line
    flags, columns) or where the unit is not SI (`rate_k_min`).
Counts
    Raw accelerometer outputs are signed counts per conversion cycle: quantized increments that
    saturate at the converter's full scale. Where a unit already reports m/s^2, "counts" means
    m/s^2 and the scale factor is close to 1.
Signs
    ``corrected = (measured - bias) / scale``; a residual is ``corrected - true``. The
    accelerometer measures specific force: at rest, level, z up, it reads +g on z.
Temperatures
    ``t = T_board - T_ref`` is the argument of every temperature function. The gradient is
    ``T_case - T_board``. In a ramp the case temperature leads and the board temperature lags.
Regimes
    A detector with memory decides whether the thermal regime is static (S = 0) or dynamic (S = 1);
    the regime is unknown while the detector has too few readings. The static set of coefficients
    applies while the regime is unknown.
Frames
    The output frame is fixed by the sensitivity axes: x along the x sensitivity axis, y in the
    plane of the x and y sensitivity axes (the misalignment matrix is lower triangular with a
    unit diagonal).
Time
    Stamps are integers, ``stamp_ns`` [ns]. A time difference in seconds is always computed from
    an integer difference, so that no result depends on the origin of time. The correction of a
    single sample gives the same result, bit for bit, as the correction of this sample in an array.

References
----------
.. [1] S. V. Golovach, "The results of applying the method of algorithmic temperature drift
   compensation for three-axis accelerometer", 2016 (in Russian), UDC 531.383.

"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .api import Columns, Corrected, Temperature, correct, fit, read
    from .errors import ThermoCompError
    from .online.compensator import Compensator
    from .online.status import CompensatorConfig
    from .unit.calibration import Calibration
    from .unit.calibration_file import load_calibration as load
    from .unit.calibration_file import save_calibration as save

__version__ = '0.2.0'

__all__ = [
    'Calibration',
    'Columns',
    'Compensator',
    'CompensatorConfig',
    'Corrected',
    'Temperature',
    'ThermoCompError',
    'correct',
    'fit',
    'load',
    'read',
    'save',
]

# The module of each public name, which is imported when the name is first used.
_HOMES = {
    'Calibration': 'unit.calibration',
    'Compensator': 'online.compensator',
    'CompensatorConfig': 'online.status',
    'ThermoCompError': 'errors',
    'load': 'unit.calibration_file:load_calibration',
    'save': 'unit.calibration_file:save_calibration',
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    module, _, attribute = _HOMES.get(name, 'api').partition(':')
    value = getattr(import_module(f'.{module}', __name__), attribute or name)
    globals()[name] = value
    return value
