"""Batches: frozen dataclasses of tensors whose first dimension is that of the members, episodes or maps."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

Value = TypeVar("Value", bound=Any)


class Batch:
    """The base of dataclasses whose tensors, and those of the batches in them, have the members first."""

    def select(self, members: Tensor) -> Self:
        """Keeps some members, by index, int64, shape [M]; one may be taken more than once."""
        return map_tensors(self, lambda values: values[members])

    def clone(self) -> Self:
        """A copy that shares no tensor."""
        return map_tensors(self, torch.clone)

    def to(self, device: torch.device | str) -> Self:
        """The same on a device."""
        return map_tensors(self, lambda values: values.to(device))


def map_tensors(value: Value, change: Callable[..., Tensor], *others: Value) -> Value:
    """Changes each tensor of a dataclass, and of the batches and mappings in it; all else stays.

    Args:
        value: the dataclass.
        change: is given a tensor, and those that have its place in the others.
        others: more of the same kind.
    """
    changed: dict[str, Any] = {}
    for name in (each.name for each in fields(value)):
        first, *rest = (getattr(one, name) for one in (value, *others))
        if isinstance(first, Tensor):
            changed[name] = change(first, *rest)
        elif isinstance(first, Batch):
            changed[name] = map_tensors(first, change, *rest)
        elif isinstance(first, Mapping):
            changed[name] = {
                key: change(inner, *(other[key] for other in rest)) if isinstance(inner, Tensor) else inner
                for key, inner in first.items()
            }
    return replace(value, **changed)
