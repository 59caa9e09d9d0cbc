# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns exchange with other tools: what lies between one's file and a calibration.

All say ``a = A (N - b)`` of a reading N. Autopilots let b depend on temperature and keep A at 1,
the tools for tumbles keep both constant. What a calibration holds beyond an autopilot's cubics is
named in the notes of an export, with the error that its loss leaves.
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
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from ..unit.gyroscope import MILLIDEGREE, Gyroscope, RateCurve, RateSet
from ..unit.prediction import bias_and_scale, ramp_states
from ..unit.rate_triad import rate_triad
from .tools import READERS, WRITERS, Content, ql, turned

_GRID = 257
#: White noise of an imported gyroscope, of which nothing is said [rad/s/sqrt(Hz)].
_RATE_NOISE = 1e-4
#: Readings in m/s^2 have scale factors near 1; beyond this factor they are something else.
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
    Write a calibration's static set as parameters of one of `WRITERS`: their `text`, and
    in the `notes` what they cannot hold.

    `number`: which set; `device_id`: by which PX4 matches it. At the attitude `up`, a unit vector,
    the drift of the scale is folded into the offset.
    """
    if up is not None and not abs(float(np.linalg.norm(up)) - 1.0) < 1e-6:
        raise ValueError(f'`up` must be a unit vector, got {up}')
    write, reference_c = WRITERS[to]
    content = _content(calibration, reference_c, up)
    text = write(content, number, device_id)
    title = f'Thermal calibration of unit {calibration.unit.serial}, by thermo_comp'
    # Whatever a note holds, it ends with its line.
    head = [f'# {one_line(said)}\n' for said in (title, *content.notes)]
    return replace(content, text=''.join(head) + text)


def _content(
    calibration: Calibration, reference_c: float | None, up: tuple[float, float, float] | None
) -> Content:
    """Take from a calibration what an autopilot's file can hold, and note the rest."""
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    sets = calibration.static.axes()
    K = np.array([axis.scale_factor for axis in axes])
    level = np.array([axis.bias + one.delta for axis, one in zip(axes, sets, strict=True)])
    range_c = calibration.static.temperature_range_c
    temperature = np.linspace(*range_c, _GRID)
    t = temperature - calibration.reference_temperature_c
    bias = np.array([one.bias_function.value(t) for one in sets]) / K[:, None]
    scale = np.array([one.scale_function.value(t) for one in sets]) - 1.0
    scale_drift = float(np.max(np.abs(scale)))
    reference_c = calibration.reference_temperature_c if reference_c is None else reference_c
    d = temperature - reference_c
    loads = calibration.gravity_m_s2 * np.array(up or (0.0, 0.0, 0.0))
    cubics, misfit = _cubics(d, (level / K)[:, None] + bias + loads[:, None] * scale)
    notes: list[str] = []
    rate_bias = None
    if misfit > 0.01 * MICRO_G:
        notes.append(f'bias functions replaced by cubics, off by {misfit / MICRO_G:.2g} ug')
    if scale_drift > 1e-8:
        rest = 'folded into the offset at one attitude' if up else 'lost'
        notes.append(f'scale over temperature is {rest}: up to {1e6 * scale_drift:.2g} ppm')
    worst = float(np.max(np.abs(calibration.misalignment - np.eye(3))))
    if worst:
        notes.append(f'misalignment is lost: up to {1e6 * worst:.3g} urad')
    notes += _losses(calibration)
    if calibration.gyroscope is not None:
        triad = rate_triad(calibration)
        rate, _ = bias_and_scale(triad, ramp_states(triad, temperature))
        rate_bias, misfit = _cubics(d, rate.T)
        if misfit > 1e-3 * MILLIDEGREE:
            off = f'{misfit / MILLIDEGREE:.2g} mdeg/s'
            notes.append(f'angular rate: replaced by cubics, off by {off}')
        notes += [f'angular rate: {one}' for one in _losses(triad)]
    if calibration.unit.input == 'counts':
        notes.append('offsets are counts divided by K: the driver must scale by these K')
    return Content(np.eye(3), cubics, reference_c, range_c, notes, rate_bias=rate_bias)


def _cubics(d: Floats, offset: Floats) -> tuple[Floats, float]:
    """Fit a cubic to the offset of each axis, and say by how much it is off at most."""
    cubics = polynomial.polyfit(d, offset.T, 3)
    return cubics.T, float(np.max(np.abs(polynomial.polyval(d, cubics) - offset)))


def _losses(calibration: Calibration) -> list[str]:
    """Say what no other tool's file can hold of a calibration."""
    notes = []
    lost = sorted({term.group for term in calibration.response if any(term.bias + term.scale)})
    if lost:
        notes.append(
            f'the thermal response is lost ({", ".join(lost)}): heating and cooling read the same'
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
    Read the file of a tool, told by what it holds, with the same set in both regimes.
    `number` chooses a set or IMU; None takes the only one there is. `full_scale` is in m/s^2.
    """
    found = (read(text, number) for read in READERS)
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
        # Of words with an offset, such as 32768, on either side of it.
        full_scale = full_scale * float(K.max()) + float(np.abs(content.bias[:, 0]).max())
    one = Polynomial((1.0,))
    sets = [unit.AxisSet(curve, one) for curve in _curves(content.bias)]
    regime = unit.RegimeSet(content.range_c, (-60.0, 60.0), *sets)
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
        provenance=unit.Provenance(
            model=content.source, notes=(*content.notes, *turned(rotation))
        ),
        gyroscope=gyroscope,
    )


def _curves(bias: Floats) -> list[Polynomial]:
    """Give each axis' cubic without its level."""
    return [Polynomial((0.0, *row[1:])) for row in bias.tolist()]
