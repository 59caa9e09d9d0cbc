# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns YAML of strangers: plain values without aliases, so that a small text stays a small object.

The calibration file has a stricter reader of its own.

"""

from __future__ import annotations

from typing import Any

import yaml

DEPTH_LIMIT = 50
_LOADER: type[yaml.SafeLoader] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


def load_plain_yaml(text: str | bytes) -> Any:
    """
    Read one YAML document of plain values.

    Parameters
    ----------
    text : str or bytes
        The document.

    Returns
    -------
    Any
        Mappings, lists, texts, numbers, dates.

    Raises
    ------
    yaml.YAMLError
        If it is no YAML, has aliases (with merge keys a few lines of them make billions of
        objects) or is nested too deeply.

    """
    depth = 0
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError('YAML aliases are not accepted')
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEPTH_LIMIT:
                raise yaml.YAMLError(f'nested deeper than {DEPTH_LIMIT}')
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    return yaml.load(text, Loader=_LOADER)  # noqa: S506 - the safe one, in C where there is one
