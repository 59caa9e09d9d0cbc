# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns play operators, the parts of which rate-independent hysteresis is made.

A play of half-width r follows its input v only where that pushes it:
``P = min(max(P, v - r), v + r)``.
"""

from __future__ import annotations


class Plays:
    """Play operators of some half-widths [K] on one input."""

    def __init__(self, widths: tuple[float, ...]) -> None:
        self.widths = widths
        self._held: list[float] = []

    def forget(self) -> None:
        """Begin anew with the next input, in the middle of every play."""
        self._held = []

    def step(self, v: float) -> None:
        """Take the next value of the input."""
        held = self._held
        if not held:
            self._held = [v] * len(self.widths)
            return
        self._held = [
            v - r if p < v - r else v + r if p > v + r else p
            for p, r in zip(held, self.widths, strict=True)
        ]

    def at(self, v: float) -> list[float]:
        """Give each play less its input, for a value that is not remembered."""
        if not self._held:
            return [0.0] * len(self.widths)
        result = []
        for held, r in zip(self._held, self.widths, strict=True):
            beside = held - v
            result.append(-r if beside < -r else r if beside > r else beside)
        return result
