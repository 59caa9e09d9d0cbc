# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the exchange with other tools: calibrations to the content of their files, and back.

All use ``a = A (N - b)`` of a reading N. In autopilots b depends on temperature and A is 1; in
tools for tumble tests both are constant. The notes of an export name the parts of a calibration
that are lost, with the resulting error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.polynomial import polynomial

from ..errors import CalibrationError
from ..text import one_line
from ..typing import Floats
from ..unit import calibration as unit
from ..unit.calibration import Calibration
from ..unit.functions import Polynomial
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY, spoken
from ..unit.prediction import bias_and_scale, ramp_states
from ..unit.provenance import Provenance
from ..unit.rate_bias import MILLIDEGREE, Gyroscope, RateCurve, RateSet
from ..unit.rate_triad import rate_triad
from .tools import TOOLS, Content, Tool, ql, turned

_GRID = 257
#: White noise assumed for an imported gyroscope [rad/s/sqrt(Hz)].
_RATE_NOISE = 1e-4
#: Largest factor between 1 and the scale factor of readings in m/s^2.
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
    Write a calibration's static set as the file of one of `TOOLS`: its `text`, and `notes` on the
    lost parts.

    `number` of the set or IMU, if the file numbers them; `device_id` by which PX4 matches the
    sensor. With `up`, a unit vector, the scale's drift in this attitude is added to the offset.
    """
    if up is not None and not abs(float(np.linalg.norm(up)) - 1.0) < 1e-6:
        raise ValueError(f'`up` must be a unit vector, got {up}')
    content = _content(calibration, TOOLS[to], up)
    text = TOOLS[to].write(content, number, device_id)
    title = f'Thermal calibration of unit {calibration.unit.serial}, by thermo_comp'
    # A note is a single line; imu_tk's reader knows no comments.
    head = [] if to == 'imu_tk' else [f'# {one_line(said)}\n' for said in (title, *content.notes)]
    return replace(content, text=''.join(head) + text)


def _content(
    calibration: Calibration, tool: Tool, up: tuple[float, float, float] | None
) -> Content:
    """Convert a calibration to the content of a tool's file, with notes on lost parts."""
    sets = calibration.static.axes()
    K = np.array([axis.scale_factor for axis in calibration.axes])
    levels = zip(calibration.axes, sets, strict=True)
    level = np.array([axis.bias + one.delta for axis, one in levels])
    range_c = calibration.static.temperature_range_c
    temperature = np.linspace(*range_c, _GRID)
    own_reference_c = calibration.reference_temperature_c
    t = temperature - own_reference_c
    # Counts are divided by K before the tool's correction, readings in m/s^2 are not.
    gain = K if calibration.unit.input == 'm/s^2' else np.ones(3)
    bias = np.array([one.bias_function.value(t) for one in sets]) / K[:, None]
    scale = np.array([one.scale_function.value(t) for one in sets]) - 1.0
    scale_drift = float(np.max(np.abs(scale)))
    reference_c = own_reference_c if tool.reference_c is None else tool.reference_c
    matrix, cubics = np.array(calibration.misalignment), np.zeros((3, 4))
    notes: list[str] = []
    if calibration.provenance.model == unit.POPULATION:
        notes.append('it is the mean of a type of unit, without the deviations of this unit')
    rate_notes, rate_bias = [], None
    if tool.is_thermal:
        d = temperature - reference_c
        loads = calibration.gravity_m_s2 * np.array(up or (0.0, 0.0, 0.0))
        offset = (level / K)[:, None] + bias + loads[:, None] * scale
        offset = gain[:, None] * offset + ((gain - 1.0) * loads)[:, None]
        cubics, misfit = _cubics(d, offset)
        if misfit > 0.01 * MICRO_G:
            notes.append(f'bias functions replaced by cubics, off by {misfit / MICRO_G:.2g} ug')
        if scale_drift > 1e-8:
            rest = 'folded into the offset at one attitude' if up else 'lost'
            notes.append(f'scale over temperature is {rest}: up to {1e6 * scale_drift:.2g} ppm')
        constant = float(np.max(np.abs(gain - 1.0)))
        if constant > 1e-8:
            rest = (
                'folded into the offset at one attitude'
                if up
                else 'lost, calibrate the six faces in the autopilot afterwards'
            )
            notes.append(f'the constant scale is {rest}: up to {1e6 * constant:.4g} ppm')
        worst = float(np.max(np.abs(matrix - np.eye(3))))
        if worst:
            notes.append(f'misalignment is lost: up to {1e6 * worst:.3g} urad')
        matrix = np.eye(3)
        if calibration.gyroscope is not None:
            triad = rate_triad(calibration)
            rate, _ = bias_and_scale(triad, ramp_states(triad, temperature))
            rate_bias, misfit = _cubics(d, rate.T)
            if misfit > 1e-3 * MILLIDEGREE:
                off = f'{misfit / MILLIDEGREE:.2g} mdeg/s'
                rate_notes.append(f'replaced by cubics, off by {off}')
            rate_notes += _losses(triad)
    else:
        matrix /= K
        cubics[:, 0] = level
        drift = (
            f'over the calibrated range the bias moves by up to '
            f'{spoken(float(np.max(np.abs(bias))))}, the scale by {1e6 * scale_drift:.2g} ppm'
        )
        if not calibration.needs_temperature:
            drift = 'it has no correction for temperature'
        notes.append(f'it holds at {reference_c:g} degC: {drift}')
        rate_notes = ['is lost'] * (calibration.gyroscope is not None)
    notes += _losses(calibration)
    notes += [f'angular rate: {note}' for note in rate_notes]
    if calibration.unit.input == 'counts':
        notes.append(
            'offsets are counts divided by K: the driver must scale by these K'
            if tool.is_thermal
            else 'it is for counts, like the calibration'
        )
    noise = (
        max(calibration.noise_density_m_s2_sqrt_hz),
        max(calibration.slow_noise_m_s2_sqrt_h),
        1.0 / calibration.unit.cycle_time_s,
    )
    return Content(matrix, cubics, reference_c, range_c, notes, noise=noise, rate_bias=rate_bias)


def _cubics(d: Floats, offset: Floats) -> tuple[Floats, float]:
    """Fit a cubic to the offset of each axis; return it and its largest error."""
    cubics = polynomial.polyfit(d, offset.T, 3)
    return cubics.T, float(np.max(np.abs(polynomial.polyval(d, cubics) - offset)))


def _losses(calibration: Calibration) -> list[str]:
    """List the parts of a calibration that no other tool's file can hold."""
    notes = []
    lost = sorted({term.group for term in calibration.response if any(term.bias + term.scale)})
    if lost:
        worth = [one.explains_m_s2 for one in calibration.evidence if one.group in lost]
        cost = f', up to {spoken(float(np.linalg.norm(worth)))} RMS' if worth else ''
        notes.append(
            f'the thermal response is lost ({", ".join(lost)}){cost}: heating and cooling read '
            'the same'
        )
    static, dynamic = (
        [(one.delta, one.bias_function, one.scale_function) for one in regime.axes()]
        for regime in calibration.regime_sets()
    )
    if static != dynamic:
        notes.append('the dynamic set is lost: the static one is used in ramps, too')
    return notes


def import_calibration(
    text: str,
    *,
    serial: str,
    number: int | None = None,
    gravity: float = STANDARD_GRAVITY,
    cycle_time_s: float = 0.005,
    full_scale: float = 16.0 * STANDARD_GRAVITY,
    noise_density: float = 200.0 * MICRO_G,
) -> Calibration:
    """
    Read the file of one of `TOOLS`, recognised by its content; both regimes get the same set.
    `number` chooses a set or IMU, None the only one. `full_scale` is in m/s^2.
    """
    found = (tool.read(text, number) for tool in TOOLS.values())
    content = next((one for one in found if one is not None), None)
    if content is None:
        raise CalibrationError(
            'no TC_A* (PX4) or INS_TCAL* (ArduPilot) parameters in the text, nor the matrices of '
            'imu_tk (.calib), imu_calib (SM, bias) or Kalibr (accelerometers.M)'
        )
    lower, upper = content.range_c
    if not lower < upper:
        raise CalibrationError(f'temperature range {lower:g}..{upper:g} degC is empty')
    rotation, matrix = ql(content.matrix)
    K = 1.0 / np.diag(matrix)
    is_si = bool((K < _NEAR_ONE).all() and (K > 1.0 / _NEAR_ONE).all())
    if not is_si and float(K.min()) < 10.0 / STANDARD_GRAVITY:
        raise CalibrationError(
            f'it takes {K.min():.3g} units per m/s^2: neither m/s^2 nor counts; convert the '
            'readings first'
        )
    (_, _, _), (yx, _, _), (zx, zy, _) = (matrix * K).tolist()
    if not is_si:
        # Samples in an offset code, as 32768, extend to both sides of the offset.
        full_scale = full_scale * float(K.max()) + float(np.abs(content.bias[:, 0]).max())
    one = Polynomial((1.0,))
    x_set, y_set, z_set = (unit.AxisSet(curve, one) for curve in _curves(content.bias))
    regime = unit.RegimeSet(content.range_c, (-60.0, 60.0), x_set, y_set, z_set)
    gyroscope = None
    if content.rate_bias is not None:
        rates = RateSet(*map(RateCurve, _curves(content.rate_bias)))
        x, y, z = content.rate_bias[:, 0].tolist()
        gyroscope = Gyroscope((x, y, z), rates, rates, (_RATE_NOISE,) * 3)
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
        provenance=Provenance(model=content.source, notes=(*content.notes, *turned(rotation))),
        gyroscope=gyroscope,
    )


def _curves(bias: Floats) -> list[Polynomial]:
    """Return each axis' cubic without its constant."""
    return [Polynomial((0.0, *row[1:])) for row in bias.tolist()]
