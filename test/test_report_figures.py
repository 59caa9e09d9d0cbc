# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures have the right numbers and are legible without colour; browsers display the pages."""

import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builders import axis_set, calibration, regime_set, rich_calibration, term
from matplotlib.colors import to_rgb
from report_helpers import certificate, evidence, fitted

from thermo_comp.report import figures
from thermo_comp.report.certificate import curves
from thermo_comp.report.evidence import LEFT_OUT, shown_bag
from thermo_comp.report.page import figures_of, position_error, schuler_peak
from thermo_comp.report.style import drawing, number, svg
from thermo_comp.thermal.regime import Regime
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.unit.gravity import MICRO_G

pytestmark = pytest.mark.usefixtures('equal_fits_once')


def test_drawn_bias_and_scale_curves_agree_with_formulas():
    # The bias of x grows by 0.3 counts per K of board temperature, and per K of the lag (600 s).
    static, dynamic = (
        regime_set(*[axis_set((0.0, 0.3), (1.0, 7e-5), delta=delta)] * 3, rate_range_k_min=(0, 2))
        for delta in (0.0, 0.5)
    )
    response = (term('board', (0.3, 0.0, 0.0), (0.0, 1e-6, 0.0), tau_s=600.0),)
    soak, heating = curves(calibration(static=static, dynamic=dynamic, response=response))
    assert (soak.program.label, heating.program.label) == ('soak', 'heating at 1 K/min')
    count = 1.0 / 300.0 / MICRO_G
    t = soak.temperature - 20.0
    assert soak.value[:, :3] == pytest.approx(np.outer(0.3 * count * t, np.ones(3)))
    assert soak.value[:, 3:] == pytest.approx(np.outer(70.0 * t, np.ones(3)))
    behind = 10.0 * (1.0 - np.exp(-(heating.temperature - heating.temperature[0]) / 10.0))
    assert heating.value[:, 0] == pytest.approx((0.3 * t + 0.5 + 0.3 * behind) * count)
    assert heating.value[:, 2] == pytest.approx((0.3 * t + 0.5) * count)
    assert heating.value[:, 4] == pytest.approx(70.0 * t + behind)


@pytest.mark.slow
def test_measured_errors_in_soaks_are_those_of_the_scale_factors():
    windows = evidence().windows
    up = np.array([position.up for position in evidence().positions])[windows.position]
    length = np.where(windows.is_dynamic, 1.0, 1.0 + 30e-6) * windows.gravity
    wrong = replace(evidence(), windows=replace(windows, force=up * length[:, None]))
    temperature, errors = figures.soak_measurements(wrong)
    assert len(temperature) >= len(wrong.positions)
    bias, scale = errors[:, :3], errors[:, 3:]
    known = np.isfinite(scale)
    assert known.any(axis=1).all()  # at least one axis measures half of gravity or more
    assert scale[known] == pytest.approx(30.0, rel=1e-4)
    assert np.linalg.norm(bias, axis=1) == pytest.approx(30.0, rel=1e-4)


def test_position_errors_and_the_map_of_the_sphere_agree_with_hand_numbers():
    # In 60 s 1 mg causes an error of 9.80665e-3 * 1800 m; 1 ug at most 1e-6 Earth diameters.
    assert position_error(1e3 * MICRO_G, 60.0) == pytest.approx(17.652, rel=1e-4)
    assert schuler_peak(MICRO_G) == pytest.approx(12.742, rel=1e-4)
    assert figures.equal_area((0.0, 0.0, 1.0), 1) == (0.0, 0.0)
    assert figures.equal_area((0.0, 1.0, 0.0), -1) == (0.0, 1.0)
    # The cap above 45 deg has 1 - sin 45 of the area of the hemisphere, and so of the disc.
    x, y = figures.equal_area((np.sqrt(0.5), 0.0, np.sqrt(0.5)), 1)
    assert x**2 + y**2 == pytest.approx(1.0 - np.sqrt(0.5))


def test_the_drawn_trace_covers_the_bag_without_a_gap_also_without_a_case():
    bag = fitted().bags[0]
    stretches = shown_bag(bag, 0, DetectorSettings()).stretches
    assert (stretches[0].regime, stretches[0].start) == (Regime.UNKNOWN, 0.0)
    assert stretches[-1].stop == pytest.approx((bag.end_ns - bag.start_ns) * 1e-9)
    for before, after in pairwise(stretches):
        assert before.stop == after.start
        assert (before.regime, before.direction) != (after.regime, after.direction)
    shown = shown_bag(replace(bag, temperatures={'board': bag.board}), 0, DetectorSettings())
    assert shown.leader == 'board'
    assert not np.isfinite(shown.case_rate).any()
    assert any(stretch.regime == Regime.DYNAMIC for stretch in shown.stretches)


UNITS = ('°C', 'K/min', 'µg', 'ppm', 'counts', '%', 'm/s²', 'position')


def look(line):
    """Return dashes, marker and darkness of a line, by which lines differ without colour."""
    dashes, colour = line._unscaled_dash_pattern, line.get_color()
    marker = f'{line.get_marker()} {line.get_markerfacecolor()}'
    darkness = round(float(np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722))), 1)
    return str(dashes), marker, darkness


@pytest.mark.parametrize(
    'draw',
    [
        figures.draw_temperatures, figures.draw_dynamics, figures.draw_residuals,
        figures.draw_gravity, figures.draw_functions, figures.draw_positions,
        figures.draw_every_position,
    ],
)  # fmt: skip
def test_lines_of_figures_differ_without_colour(draw):
    with drawing():
        figure = draw(evidence())
        figure.draw_without_rendering()
        for axes in figure.axes:
            looks = [look(line) for line in axes.get_legend_handles_labels()[0]]
            assert len(set(looks)) == len(looks)
            label = axes.get_ylabel()
            assert not (axes.axison and label) or any(unit in label for unit in UNITS), label


def test_the_area_of_a_ring_is_proportional_to_the_residual_of_its_position():
    with drawing():
        lines = [line for axes in figures.draw_positions(evidence()).axes for line in axes.lines]
    rings = [line for line in lines if line.get_marker() == 'o' and line.get_mfc() == 'none']
    areas = np.sort([ring.get_markersize() ** 2 for ring in rings])
    rms = np.sort([place.residual_rms.get(LEFT_OUT, 0.0) for place in evidence().positions])
    assert areas / areas[-1] == pytest.approx(rms / rms[-1])


@pytest.mark.parametrize(
    ('value', 'text'),
    [(0.0, '0'), (1951.3, '1950'), (-0.0824, '−0.082'), (4.2e-5, '0.000'),
     (-4.2e-5, '0.000'), (302.992252, '303'), (9.99, '9.99'), (999.6, '1000'),
     (3.2e10, '3.20e+10'), (float('nan'), '–')],
)  # fmt: skip
def test_numbers_have_three_to_four_digits(value, text):
    assert number(value) == text


def test_the_label_of_a_drawing_is_escaped():
    with drawing():
        text = svg(figures.draw_temperatures(evidence()), 'x', '"><script>')
    assert '<script>' not in text
    assert 'aria-label="&quot;&gt;&lt;script&gt;"' in text


def test_the_figure_of_rates_shows_the_bias_of_the_gyroscope():
    unit = rich_calibration()
    with drawing():
        figure = figures.draw_rates(replace(evidence(), calibration=unit))
    for axes, curve in zip(figure.axes, unit.gyroscope.static.axes(), strict=True):
        celsius, drawn = np.array(axes.get_lines()[0].get_data(), dtype=float)
        bias = np.degrees(curve.bias_function.value(celsius - 20.0)) * 1e3
        slope = np.polyfit(celsius, bias, 1)[0]
        # The figure shows the gyroscope's bias minus its linear fit over temperature [mdeg/s].
        np.testing.assert_allclose(drawn, bias - slope * (celsius - 20.0), atol=1e-9)
        assert f'{slope:+.3g}'.replace('-', '\u2212') in axes.get_title(loc='left')
    assert 'rates' in [figure.name for figure in figures_of(replace(evidence(), calibration=unit))]
    assert 'rates' not in [figure.name for figure in figures_of(evidence())]


TIMEOUT_S = 60.0
HEADLESS = (
    *('--headless', '--no-sandbox', '--disable-gpu', '--no-first-run', '--disable-sync'),
    *('--disable-background-networking', '--disable-component-update'),
)


def browse(folder, page, *options):
    """Open a page beside the certificate in a browser; return the browser's log."""
    path = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser'))), None)
    if path is None:
        pytest.skip('no Chromium here (Debian: apt install chromium)')
    (folder / 'page.html').write_text(certificate(), encoding='utf-8')
    profile = f'--user-data-dir={folder / "profile"}'
    command = [path, *HEADLESS, profile, *options, (folder / page).as_uri()]
    keys = {'capture_output': True, 'text': True, 'timeout': TIMEOUT_S}
    return subprocess.run(command, check=True, **keys).stderr


def test_a_browser_draws_the_page_at_390_pixels_without_errors(tmp_path):
    # The window of a headless browser has a minimum width, but a frame in it can be 390 px wide.
    (
        tmp_path / 'frame.html'
    ).write_text("""<iframe src="page.html" style="width:390px;height:800px;border:0"></iframe>
<script>onload = () => {
  const page = frames[0].document;
  const shown = [page.documentElement, ...page.querySelectorAll("div:not(.drawing)")];
  console.log(shown.filter(one => one.scrollWidth > Math.max(one.clientWidth, 1)).length
    + " of " + page.querySelectorAll("table").length + " tables are cut");
}</script>""")
    screenshot = f'--screenshot={tmp_path / "phone.png"}'
    log = browse(tmp_path, 'frame.html', '--enable-logging=stderr',
                 '--allow-file-access-from-files', screenshot)  # fmt: skip
    (text,) = [line for line in log.splitlines() if 'CONSOLE' in line]
    cut, n_tables = re.search(r'(\d+) of (\d+) tables are cut', text).groups()
    assert int(n_tables) >= 5
    assert cut == '0'
    assert (tmp_path / 'phone.png').stat().st_size > 10_000


def test_no_printed_page_is_empty(tmp_path):
    printing = f'--print-to-pdf={tmp_path / "page.pdf"}'
    browse(tmp_path, 'page.html', '--no-pdf-header-footer', printing)
    printed = (tmp_path / 'page.pdf').read_bytes()
    pages = re.findall(rb'/Type /Page\n.*?/Contents (\d+) 0 R', printed, re.DOTALL)
    assert 5 <= len(pages) <= 12
    for page in pages:
        drawn = re.search(rb'\n%s 0 obj.*?stream\r?\n' % page, printed, re.DOTALL)
        # A printed page with content has over 200 lines of drawing commands.
        assert zlib.decompressobj().decompress(printed[drawn.end() :]).count(b'\n') > 200
