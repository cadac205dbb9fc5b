"""A short representation of values with many fields, of at most six lines."""

import textwrap
from collections.abc import Mapping, Sized
from dataclasses import fields, is_dataclass
from typing import Any

MAX_LINES, _WIDTH, _MAX_TEXT = 6, 100, 40
_SPACE = "\0"


def short_repr(value: Any) -> str:
    """Return the fields of a dataclass, with dtype and shape of tensors and arrays."""
    texts = [
        _field(field.name, getattr(value, field.name))
        for field in fields(value)
        if field.repr
    ]
    # Hide spaces while lines are broken, so that each field stays on one line.
    text = ", ".join(field.replace(" ", _SPACE) for field in texts if field)
    text = f"{type(value).__name__}({text})"
    lines = textwrap.wrap(
        text, _WIDTH, subsequent_indent="  ", max_lines=MAX_LINES, placeholder=" …)"
    )
    return "\n".join(lines).replace(_SPACE, " ")


def _field(name: str, value: Any) -> str:
    if value is None:
        return ""
    if hasattr(value, "dtype") and hasattr(value, "shape") and not is_dataclass(value):
        return f"{name} {str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
    text = repr(value)
    if len(text) <= _MAX_TEXT:
        return f"{name}={text}"
    if is_dataclass(value):
        shape = getattr(value, "shape", None)
        type_name = type(value).__name__
        if shape is None:
            return f"{name} {type_name}"
        return f"{name} {type_name} {list(shape)}"
    size = f" of {len(value)}" if isinstance(value, Sized) else ""
    kind = "mapping" if isinstance(value, Mapping) else type(value).__name__
    return f"{name} {kind}{size}"
