# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the export of calibrations to the files of other tools, and the import of such files.

All tools correct a reading N to a specific force ``a = A (N - b)``. In autopilots the bias b
depends on temperature and the matrix A is the identity; in tools for tumble tests b and A are
constant. The notes of an export list the parts of the calibration that the file cannot hold, and
for most parts the resulting error.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from ..errors import CalibrationError
from ..text import one_line
from ..typing import Floats
from ..unit import calibration as unit
from ..unit.calibration import Calibration, rate_triad
from ..unit.functions import Polynomial
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY, ug_text
from ..unit.prediction import bias_and_scale, ramp_states
from ..unit.provenance import Provenance
from ..unit.rate_bias import MILLIDEGREE, Gyroscope, RateCurve, RateSet
from .tools import TOOLS, Content, ql, rotation_notes

_GRID = 257  # number of temperatures at which a curve is computed
_RATE_NOISE = 1e-4  # white noise assumed for an imported gyroscope [rad/s/sqrt(Hz)]
#: A file is taken to be in m/s^2 if all scale factors are below this number and above its inverse.
_NEAR_ONE = 2.0


def export_calibration(
    calibration: Calibration,
    to: str,
    *,
    number: int | None = None,
    device_id: int = 0,
    up: tuple[float, float, float] | None = None,
) -> Content:
    """
    Write a calibration's constants and static curves in the format of one of `TOOLS`; the result
    has the file's `text`, and `notes` on the parts of the calibration that the file cannot hold.
    `number` is the number of the parameter set or IMU, if the file numbers them; PX4 matches the
    sensor by `device_id`. With `up`, the unit vector of the specific force at rest, the scale
    error times gravity in this attitude is added to the offset of an autopilot.
    """
    if up is not None and not abs(float(np.linalg.norm(up)) - 1.0) < 1e-6:
        raise ValueError(f'`up` must be a unit vector, got {up}')
    tool, curves = TOOLS[to], _static_curves(calibration)
    if tool.is_thermal:
        reference_c = tool.reference_c or calibration.reference_temperature_c
        content = _thermal(calibration, curves, reference_c, up)
        K = ' '.join(f'{factor:.6g}' for factor in curves.K)
        of_counts = (
            f'the offsets are in m/s^2: the driver must divide counts by K of x y z {K} counts '
            'per m/s^2'
        )
    else:
        content = _constant(calibration, curves)
        of_counts = 'the file corrects samples in counts, as the calibration does, not in m/s^2'
    of_type = 'the calibration is the mean of a type of unit, without the deviations of this unit'
    notes = [of_type] * (calibration.provenance.model == unit.POPULATION)
    notes += [*content.notes, *_losses(calibration)]
    notes += [of_counts] * (calibration.unit.input == 'counts')
    white, walk = calibration.noise_density_m_s2_sqrt_hz, calibration.slow_noise_m_s2_sqrt_h
    noise = max(white), max(walk), 1.0 / calibration.unit.cycle_time_s
    content = replace(content, notes=notes, noise=noise, number=number, device_id=device_id)
    text = tool.write(content)
    title = f'Thermal calibration of unit {calibration.unit.serial}, by thermo_comp'
    # Write each note as a comment line; the reader of imu_tk does not accept comments.
    head = [] if to == 'imu_tk' else [f'# {one_line(line)}\n' for line in (title, *content.notes)]
    return replace(content, text=''.join(head) + text)


class _Curves(NamedTuple):
    """Scale factors and biases of the three axes, and their static curves over temperature."""

    temperature: Floats  # shape (n,)
    K: Floats  # scale factors at the reference temperature, shape (3,)
    level: Floats  # biases at the reference temperature, in units of the input, shape (3,)
    bias: Floats  # difference of the bias from `level` [m/s^2], shape (3, n)
    scale: Floats  # relative difference of the scale factor from K, shape (3, n)

    @property
    def scale_drift(self) -> float:
        """Largest relative change of a scale factor within the range of temperatures."""
        return float(np.max(np.abs(self.scale)))


def _static_curves(calibration: Calibration) -> _Curves:
    temperature = np.linspace(*calibration.static.temperature_range_c, _GRID)
    at = np.array([calibration.reference_temperature_c, *temperature])
    bias, scale = bias_and_scale(calibration, ramp_states(calibration, at))
    counts = (bias * [axis.scale_factor for axis in calibration.axes]).T
    K, level = scale[0], counts[:, 0]
    change = (counts[:, 1:] - level[:, None]) / K[:, None]
    return _Curves(temperature, K, level, change, scale[1:].T / K[:, None] - 1.0)


def _thermal(
    calibration: Calibration,
    curves: _Curves,
    reference_c: float,
    up: tuple[float, float, float] | None,
) -> Content:
    """Return each axis' offset over temperature as a cubic, for an autopilot."""
    d, notes = curves.temperature - reference_c, []
    # The driver divides counts by K before the autopilot's correction, but not samples in m/s^2.
    gain = curves.K if calibration.unit.input == 'm/s^2' else np.ones(3)
    loads = calibration.gravity_m_s2 * np.array(up or (0.0, 0.0, 0.0))
    offset = (curves.level / curves.K)[:, None] + curves.bias + loads[:, None] * curves.scale
    offset = gain[:, None] * offset + ((gain - 1.0) * loads)[:, None]
    cubics, misfit = _cubics(d, offset)
    if misfit > 0.01 * MICRO_G:
        notes.append(f'cubics replace the bias functions: error up to {ug_text(misfit)}')
    place = 'included in the offset for one attitude' if up else 'lost'
    if curves.scale_drift > 1e-8:
        size = _millionths(curves.scale_drift)
        notes.append(f'scale over temperature is {place}: up to {size} ppm')
    constant = float(np.max(np.abs(gain - 1.0)))
    if constant > 1e-8:
        advice = '; calibrate six faces in the autopilot' * (not up)
        notes.append(f'the constant scale is {place}: up to {1e6 * constant:.4g} ppm{advice}')
    worst = float(np.max(np.abs(np.array(calibration.misalignment) - np.eye(3))))
    if worst:
        notes.append(f'misalignment is lost: up to {_millionths(worst)} urad')
    rate_bias = None
    if calibration.gyroscope is not None:
        triad = rate_triad(calibration)
        rate, _ = bias_and_scale(triad, ramp_states(triad, curves.temperature))
        rate_bias, misfit = _cubics(d, rate.T)
        error = f'cubics replace the bias functions: error up to {misfit / MILLIDEGREE:.2g} mdeg/s'
        of_rate = [*[error] * (misfit > 1e-3 * MILLIDEGREE), *_losses(triad)]
        notes += [f'angular rate: {note}' for note in of_rate]
    range_c = calibration.static.temperature_range_c
    return Content(np.eye(3), cubics, reference_c, range_c, notes, rate_bias=rate_bias)


def _millionths(part: float) -> str:
    """Format a ratio in millionths, with two digits or as a whole number."""
    value = 1e6 * part
    return f'{value:.2g}' if value < 99.5 else f'{value:.0f}'


def _constant(calibration: Calibration, curves: _Curves) -> Content:
    """Return bias, scale and misalignment at the reference temperature, for tools like imu_tk."""
    drift = 'the calibration has no correction for temperature'
    if calibration.needs_temperature:
        bias = ug_text(float(np.max(np.abs(curves.bias))))
        drift = f'over the calibrated range the bias changes by up to {bias}, the scale by '
        drift += f'{_millionths(curves.scale_drift)} ppm'
    reference_c = calibration.reference_temperature_c
    notes = [f'the values of the file hold at {reference_c:g} degC: {drift}']
    notes += ['the bias of the angular rate is lost'] * (calibration.gyroscope is not None)
    cubics = np.pad(curves.level[:, None], ((0, 0), (0, 3)))
    matrix = np.array(calibration.misalignment) / curves.K
    range_c = calibration.static.temperature_range_c
    return Content(matrix, cubics, reference_c, range_c, notes)


def _cubics(d: Floats, offset: Floats) -> tuple[Floats, float]:
    """Fit a cubic to the offset of each axis; return the cubics and the largest residual."""
    cubics = polynomial.polyfit(d, offset.T, 3)
    return cubics.T, float(np.max(np.abs(polynomial.polyval(d, cubics) - offset)))


def _losses(calibration: Calibration) -> list[str]:
    """List the parts of a calibration that no file of `TOOLS` can hold."""
    notes = []
    lost = sorted({term.group for term in calibration.response if any(term.bias + term.scale)})
    if lost:
        rms = [group.explains_m_s2 for group in calibration.evidence if group.group in lost]
        size = f', up to {ug_text(float(np.linalg.norm(rms)))} RMS' if rms else ''
        notes.append(
            f'the thermal response is lost ({", ".join(lost)}){size}: heating and cooling get '
            'the same correction'
        )
    static, dynamic = (
        [(axis.delta, axis.bias_function, axis.scale_function) for axis in regime.axes()]
        for regime in calibration.regime_sets()
    )
    if static != dynamic:
        notes.append('the dynamic coefficients are lost: ramps get the static coefficients, too')
    if calibration.nonlinearity is not None and calibration.nonlinearity.terms:
        notes.append('the terms nonlinear in specific force are lost')
    return notes


def import_calibration(
    text: str,
    *,
    serial: str,
    number: int | None = None,
    gravity: float = STANDARD_GRAVITY,
    cycle_time_s: float | None = None,
    full_scale: float = 16.0 * STANDARD_GRAVITY,
    noise_density: float | None = None,
) -> Calibration:
    """
    Read the file of one of `TOOLS`, recognised by its content; both regimes get the same curves.
    `number` chooses a parameter set or IMU (None: the only one in use); `full_scale` is in m/s^2.
    `cycle_time_s` [s] and `noise_density` [m/s^2/sqrt(Hz)] default to the values in the file; if
    the file has no such values, to 5 ms and 200 ug/sqrt(Hz).
    """
    readings = (tool.read(text, number) for tool in TOOLS.values())
    content = next((reading for reading in readings if reading is not None), None)
    if content is None:
        raise CalibrationError(
            'no TC_A* (PX4) or INS_TCAL* (ArduPilot) parameters in the text, nor the matrices of '
            'imu_tk (.calib), imu_calib (SM, bias) or Kalibr (accelerometers.M)'
        )
    lower, upper = content.range_c
    if not lower < upper:
        raise CalibrationError(f'temperature range {lower:g}..{upper:g} degC is empty')
    white, _, rate_hz = content.noise
    cycle_time_s = cycle_time_s or 1.0 / (rate_hz or 200.0)
    noise_density = noise_density or white or 200.0 * MICRO_G
    rotation, matrix = ql(content.matrix)
    K = 1.0 / np.diag(matrix)
    is_si = bool((K < _NEAR_ONE).all() and (K > 1.0 / _NEAR_ONE).all())
    if not is_si and float(K.min()) < 10.0 / STANDARD_GRAVITY:
        raise CalibrationError(
            f'the smallest scale factor of the file is {K.min():.3g} units per m/s^2, so its '
            'samples are neither in m/s^2 nor in counts: convert the samples to m/s^2 and make '
            'the file again'
        )
    (_, _, _), (yx, _, _), (zx, zy, _) = (matrix * K).tolist()
    if not is_si:
        # With an offset, such as 32768 counts, readings reach the offset plus the full scale.
        full_scale = full_scale * float(K.max()) + float(np.abs(content.bias[:, 0]).max())
    unity = Polynomial((1.0,))
    x_set, y_set, z_set = (unit.AxisSet(curve, unity) for curve in _curves(content.bias))
    regime = unit.RegimeSet(content.range_c, (-60.0, 60.0), x_set, y_set, z_set)
    gyroscope = None
    if content.rate_bias is not None:
        rates = RateSet(*map(RateCurve, _curves(content.rate_bias)))
        x, y, z = content.rate_bias[:, 0].tolist()
        gyroscope = Gyroscope((x, y, z), rates, rates, (_RATE_NOISE,) * 3)
    notes = [*content.notes, *rotation_notes(rotation)]
    levels = zip(K.tolist(), content.bias[:, 0].tolist(), strict=True)
    return Calibration(
        format_version=unit.FORMAT_VERSION,
        unit=unit.Unit(serial, 'm/s^2' if is_si else 'counts', full_scale, cycle_time_s),
        reference_temperature_c=content.reference_c,
        gravity_m_s2=gravity,
        axes=unit.Axes(*(unit.AxisReference(scale, bias) for scale, bias in levels)),
        static=regime,
        dynamic=regime,
        noise_density_m_s2_sqrt_hz=(noise_density,) * 3,
        misalignment=((1.0, 0.0, 0.0), (yx, 1.0, 0.0), (zx, zy, 1.0)),
        provenance=Provenance(model=content.source, notes=tuple(notes)),
        gyroscope=gyroscope,
    )


def _curves(bias: Floats) -> list[Polynomial]:
    """Return the cubics of the rows of `bias`, with constant terms of 0."""
    return [Polynomial((0.0, *row[1:])) for row in bias.tolist()]
