"""What a large value looks like in a few lines: numbers and names whole, arrays by their shape."""

from __future__ import annotations

import dataclasses
from typing import Any

#: Characters of a text, and members of a tuple, that are shown.
TEXT, MEMBERS = 60, 8


def brief(value: Any) -> str:
    """A dataclass as `Name(field=..., ...)`; for `__repr__` of results that hold much."""
    fields = dataclasses.fields(value)
    shown = ", ".join(f"{item.name}={_shown(getattr(value, item.name))}" for item in fields)
    return f"{type(value).__name__}({shown})"


def _shown(value: Any) -> str:
    if hasattr(value, "shape") and value.shape:
        return f"<{' x '.join(map(str, value.shape))}>"
    if isinstance(value, str):
        return repr(value) if len(value) <= TEXT else f"<{len(value)} characters>"
    if dataclasses.is_dataclass(value):
        return f"<{type(value).__name__}>"
    if isinstance(value, tuple | list):
        if len(value) <= MEMBERS and all(isinstance(item, str | int | float) for item in value):
            return repr(value)
        return f"<{len(value)} of {type(value[0]).__name__}>"
    if isinstance(value, dict):
        return f"<{len(value)} entries>"
    return repr(value)
