# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the decorator of methods that keep their last result."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

_Self = TypeVar('_Self')
_Given = ParamSpec('_Given')
_Result = TypeVar('_Result')


def last_result_kept(
    method: Callable[Concatenate[_Self, _Given], _Result],
) -> Callable[Concatenate[_Self, _Given], _Result]:
    """Keep the last result of a method; it is returned again for the same objects as arguments."""
    name = f'_last_{method.__name__}'

    @wraps(method)
    def kept(self: _Self, /, *args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        given = (*args, *kwargs.values())
        last: tuple[tuple[object, ...], _Result] | None = self.__dict__.get(name)
        if last is None or any(a is not b for a, b in zip(last[0], given, strict=True)):
            last = given, method(self, *args, **kwargs)
            self.__dict__[name] = last
        return last[1]

    return kept
