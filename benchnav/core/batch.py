"""Batches: frozen dataclasses of tensors whose first dimension is that of the members, episodes or maps."""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any, Self, TypeVar, cast

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
    """Changes each tensor of a dataclass, and of the batches and tuples of batches in it; all else stays.

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
        elif isinstance(first, tuple) and first and isinstance(first[0], Batch):
            changed[name] = tuple(
                map_tensors(own, change, *same) for own, *same in zip(first, *rest, strict=True)
            )
    return replace(value, **changed)


def first_tensor(value: Batch) -> Tensor:
    """The first tensor of a dataclass, the batches and tuples of batches in it included.

    Raises:
        StopIteration: it has none.
    """
    return next(_tensors(value))


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    parts = (
        [getattr(value, field.name) for field in fields(cast(Any, value))]
        if isinstance(value, Batch)
        else value
    )
    for part in parts if isinstance(parts, list | tuple) else ():
        yield from _tensors(part)
