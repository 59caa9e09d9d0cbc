# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate has all required statements; its page loads no file and runs no script."""

import re
import tracemalloc
from dataclasses import replace
from html.parser import HTMLParser

import builders
import numpy as np
import pytest
from report_helpers import LEFT_OUT_RMS, RATE_HZ, certificate, evidence, fitted, run, write_bag
from simulation_helpers import ideal_regime

from thermo_comp import __version__
from thermo_comp.errors import OutputError
from thermo_comp.fitting.reduction import Readings
from thermo_comp.judging.evaluation import open_bags
from thermo_comp.recording.writer import BagWriter
from thermo_comp.report.evidence import LEFT_OUT, evidence_of_bags
from thermo_comp.report.page import figures_of, render_report, write_report
from thermo_comp.report.style import spelt
from thermo_comp.thermal.regime import Regime

pytestmark = pytest.mark.usefixtures('equal_fits_once')

VOID = {'meta', 'br', 'path', 'use', 'rect', 'image'}


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.source, self.text, self.tags, self.open = text, '', [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != 'style':
            self.text += data

    def names(self):
        return {tag for tag, _ in self.tags}


def page_of(evidence, folder, **keys):
    path = folder / 'report.html'
    write_report(evidence, path, **keys)
    return Page(path.read_text(encoding='utf-8'))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('report') / 'held_out.mcap')


@pytest.fixture(scope='module')
def opened(bag):
    return open_bags([bag])


@pytest.fixture(scope='module')
def page():
    return Page(certificate())


def test_the_certificate_has_its_statements_and_residuals_and_runs_no_script(page):
    assert not page.open  # every tag is closed
    for fact in (
        *('Unit thermostatted-0001', evidence().calibration.provenance.created),
        *(f'thermo_comp {__version__}', '9.80665 m/s²', f'{1:064x}', f'{9:064x}'),
        *('Residual after each step of the model', 'Contribution of each part of the model'),
        *('parts that lag the board', 'after 600 s, m', '12.7 m per µg'),
    ):
        assert fact in page.text
    for figure in figures_of(evidence()):
        assert figure.question in page.text
    assert not re.search(r'\bnan\b', page.text)
    shown = [position.residual_rms.get(LEFT_OUT) for position in evidence().positions]
    assert shown == [*LEFT_OUT_RMS, None]
    assert 'left out, µg RMS' in page.text
    assert 'Left out: RMS of |f| − g of each position by a fit to the other pos' in page.text
    assert not page.names() & {'script', 'img', 'link', 'iframe', 'object', 'embed', 'form'}
    for tag, attributes in page.tags:
        for name, value in attributes.items():
            assert not name.startswith('on'), f'{tag} {name}'
            if name in ('href', 'src', 'xlink:href'):
                assert value.startswith('#')
    style = next(a['content'] for t, a in page.tags if t == 'meta' and 'http-equiv' in a)
    assert "default-src 'none'" in style
    ids = [attributes['id'] for _, attributes in page.tags if 'id' in attributes]
    assert len(set(ids)) == len(ids)
    assert set(re.findall(r'(?:url\(|href=")#([^)"]*)', page.source)) <= set(ids)


@pytest.mark.usefixtures('no_figures')
def test_the_page_states_whether_a_bag_was_fitted(opened, page):
    calibration = fitted().calibration
    assert 'positions in bags of the fit' in page.text
    unseen = evidence_of_bags(opened, calibration)
    assert '1 position in bags that the fit did not use' in Page(render_report(unseen)).text
    sources = (replace(calibration.provenance.sources[0], sha256=unseen.bags[0].source.sha256),)
    provenance = replace(calibration.provenance, sources=sources)
    seen = evidence_of_bags(opened, replace(calibration, provenance=provenance))
    assert '1 position in bags of the fit' in Page(render_report(seen)).text


def test_a_page_without_calibration_shows_temperatures_derivatives_and_regime(opened, tmp_path):
    seen = evidence_of_bags(opened)
    shown = seen.shown
    truth = run(0).truth
    ramp = (shown.time > 17 * 60) & (shown.time < 21 * 60)
    assert 1.0 < np.mean(shown.case_rate[ramp]) * 60.0 < 1.6
    dynamic = np.zeros(len(truth.grid_s), bool)
    for stretch in shown.stretches:
        inside = (truth.grid_s >= stretch.start) & (truth.grid_s < stretch.stop)
        dynamic[inside] = stretch.regime == Regime.DYNAMIC
    ideal = ideal_regime(run(0), 0.1)
    known = truth.grid_s > 10 * 60
    assert np.mean(dynamic[known] == ideal[known]) > 0.9
    directions = [s.direction for s in shown.stretches if s.direction]
    assert (directions[0], directions[-1]) == (1, -1)
    page = page_of(seen, tmp_path)
    assert 'no calibration was judged' in page.text
    assert 'means over 60 s at rest' in page.text
    assert 'means over' not in page_of(replace(seen, windows=None), tmp_path / 'without').text
    assert [figure.name for figure in figures_of(seen)] == ['temperatures', 'dynamics']
    assert all(figure.question in page.text for figure in figures_of(seen))


def test_texts_of_a_bag_or_a_calibration_are_escaped_in_the_page(tmp_path, monkeypatch):
    evil = '<script>alert("x")</script>'
    path = tmp_path / "a'b<img src=x onerror=alert(1)>$\\frac{.mcap"
    bag = write_bag(path, frame_id=evil, serial=evil)
    calibration = fitted().calibration
    provenance = replace(
        calibration.provenance, created=evil, tool_version=evil, model=evil, notes=(evil,),
        sources=(replace(calibration.provenance.sources[0], name=evil, sha256=evil),),
    )  # fmt: skip
    unit = replace(calibration.unit, serial=evil)
    calibration = replace(calibration, unit=unit, provenance=provenance)
    judged = evidence_of_bags(open_bags([bag]), calibration)
    undrawn = 'thermo_comp.report.page.drawn_figures'
    monkeypatch.setattr(undrawn, lambda figures: [(figure, '') for figure in figures])
    page = Page(render_report(judged))
    assert page.text.count(evil) >= 6
    assert '$\\frac{.mcap' in page.text
    assert not page.names() & {'script', 'img'}
    assert not any(name.startswith('on') for _, attributes in page.tags for name in attributes)


def test_the_page_of_a_bag_of_a_day_is_small(monkeypatch):
    # A day of readings at 2 Hz has hundreds of points per pixel.
    shown, windows = evidence().shown, evidence().windows
    time = np.arange(0.0, 86400.0, 0.5)
    value = 20.0 + 15.0 * np.sin(time / 9000.0) + np.random.default_rng(1).normal(size=len(time))
    readings = Readings(shown.start_ns + (time * 1e9).astype(np.int64), value)
    rows = np.resize(np.arange(len(windows)), 8640)
    zeros = np.zeros(8640, np.int64)
    windows = replace(windows.select(rows), bag=zeros, position=zeros, time=np.arange(8640) * 10.0)
    long = replace(evidence(), windows=windows)
    bag = replace(shown.bag, temperatures={'board': readings, 'case': readings})
    vars(long)['shown'] = replace(shown, bag=bag, duration_s=86400.0)
    figures = [figure for figure in figures_of(long) if figure.name != 'functions']
    monkeypatch.setattr('thermo_comp.report.page.figures_of', lambda _: figures)
    assert len(render_report(long).encode()) < 1_900_000


def test_a_bag_is_read_for_a_page_in_limited_memory(tmp_path):
    simulated = run(0)
    n_times = 50
    with BagWriter(tmp_path / 'long.mcap') as writer:
        writer.write_temperature('temperature/board', simulated.board_stamp_ns, simulated.board)
        for k in range(n_times):
            step = round(k * 1e9 / RATE_HZ / n_times)
            writer.write_counts('accel/counts', simulated.accel_stamp_ns + step, simulated.counts)
    tracemalloc.start()
    try:
        (opened,) = open_bags([tmp_path / 'long.mcap'])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert opened.n_samples == n_times * len(simulated.counts)
    # The samples and stamps of the whole bag would need more than 32 bytes per sample.
    assert peak < 64 * opened.n_samples


def test_a_calibration_without_bags_gives_a_page_and_figures_as_png(tmp_path):
    folder = tmp_path / 'new' / 'figures'
    page = page_of(evidence_of_bags([], fitted().calibration), tmp_path, figures=folder)
    assert 'no recording was judged' in page.text
    assert '01.mcap' in page.text
    assert f'{1:064x}' in page.text
    names = [figure.name for figure in figures_of(evidence())]
    without_bags = [name for name in names if name in ('functions', 'step', 'hysteresis')]
    files = sorted(folder.iterdir())
    expected = [f'{i}_{name}.png' for i, name in enumerate(without_bags, 1)]
    assert [path.name for path in files] == expected
    assert all(path.read_bytes().startswith(b'\x89PNG') for path in files)


def test_the_page_is_written_atomically(tmp_path):
    target = tmp_path / 'page.html'
    target.write_text('<!doctype html>old')
    folder = tmp_path / 'figures'
    folder.write_text('in the way')
    plain = evidence_of_bags([], builders.calibration())
    with pytest.raises(OutputError, match='figures is not a directory'):
        write_report(plain, target, figures=folder)
    assert target.read_text() == '<!doctype html>old'
    assert sorted(path.name for path in tmp_path.iterdir()) == ['figures', 'page.html']


@pytest.mark.usefixtures('no_figures')
def test_each_verdict_has_a_colour_in_the_page(opened):
    assert evidence().level in ('good', 'reserved')
    calibration = fitted().calibration
    sets = (replace(each, temperature_range_c=(19.0, 22.0)) for each in calibration.regime_sets())
    narrow = replace(calibration, **dict(zip(('static', 'dynamic'), sets, strict=True)))
    judged = evidence_of_bags(opened, narrow)
    assert judged.judgement.sections['outside'].n > 0
    assert 'outside the calibrated ranges not judged' in judged.headline
    strict = evidence_of_bags(opened, calibration, tolerance=1e-9)
    assert (strict.level, strict.judgement.verdict) == ('poor', 'recalibrate')
    page = Page(render_report(strict))
    assert '<section class="verdict poor"' in page.source
    assert spelt(strict.judgement.reason) in page.text
