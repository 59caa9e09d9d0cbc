# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the judgement of a calibration against recordings: one judge, for every command."""

from .evaluation import Evaluation, evaluate, judge_bags, open_bags
from .judgement import Judgement, judge
from .verdicts import SECTIONS, Verdict
from .windows import WINDOW_S, Windows, corrected_windows

__all__ = [
    'SECTIONS',
    'WINDOW_S',
    'Evaluation',
    'Judgement',
    'Verdict',
    'Windows',
    'corrected_windows',
    'evaluate',
    'judge',
    'judge_bags',
    'open_bags',
]
