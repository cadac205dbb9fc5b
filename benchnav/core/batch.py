"""Batches: frozen dataclasses of tensors whose first dimension indexes the elements.

Elements are episodes or maps. Letters in shapes: B elements; M selected elements.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Self, TypeVar, cast

import torch
from torch import Tensor

from benchnav.core.short_repr import short_repr

Value = TypeVar("Value", bound=Any)


class Batch:
    """Base class of dataclasses whose tensors and nested batches have B elements."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Set the short representation, which the dataclass decorator keeps."""
        super().__init_subclass__(**kwargs)
        cls.__repr__ = short_repr  # type: ignore[method-assign]

    def select(self, members: Tensor) -> Self:
        """Return a batch of selected elements; an index may repeat.

        Args:
            members: indices of the elements, int64, shape [M].
        """
        # A nested batch may override `select`.
        return _mapped(
            self,
            lambda values: values[members],
            lambda inner: inner.select(members),
            (),
        )

    def put(self, members: Tensor, others: Self) -> Self:
        """Return a batch with some elements replaced.

        Args:
            members: indices of the elements to replace, int64, shape [M].
            others: the M new elements.
        """
        return map_tensors(
            self, lambda old, new: old.index_copy(0, members, new), others
        )

    def clone(self) -> Self:
        """Return a copy that shares no tensor."""
        return map_tensors(self, torch.clone)

    def to(self, device: torch.device | str) -> Self:
        """Return the batch on a device."""
        return map_tensors(self, lambda values: values.to(device))


def map_tensors(value: Value, change: Callable[..., Tensor], *others: Value) -> Value:
    """Apply a function to each tensor of a dataclass.

    This includes nested batches, tuples of batches and mappings; other fields stay.

    Args:
        value: the dataclass.
        change: function of a tensor and of the corresponding tensors of `others`.
        others: dataclasses of the same type.
    """
    return _mapped(
        value, change, lambda first, *rest: map_tensors(first, change, *rest), others
    )


def _mapped(
    value: Value,
    change: Callable[..., Tensor],
    inner: Callable[..., Any],
    others: Sequence[Any],
) -> Value:
    """Apply `change` to each tensor and `inner` to each nested batch."""
    batch: Any = value
    changes = {}
    for field in fields(batch):
        name = field.name
        rest = [getattr(other, name) for other in others]
        changes[name] = _changed(getattr(batch, name), change, inner, rest)
    return cast(Value, replace(batch, **changes))


def _changed(
    first: Any,
    change: Callable[..., Tensor],
    inner: Callable[..., Any],
    rest: Sequence[Any],
) -> Any:
    if isinstance(first, Tensor):
        return change(first, *rest)
    if isinstance(first, Batch):
        return inner(first, *rest)
    if isinstance(first, tuple) and first and isinstance(first[0], Batch):
        return tuple(inner(*batches) for batches in zip(first, *rest, strict=True))
    if isinstance(first, Mapping):
        return {
            key: _changed(value, change, inner, [mapping[key] for mapping in rest])
            for key, value in first.items()
        }
    return first


def put_if_alike(value: Value, members: Tensor, others: Value) -> Value:
    """Replace selected elements by those of another batch of the same type and shapes.

    Args:
        value: batch of B elements.
        members: indices of the elements, int64, shape [M].
        others: batch of B elements.

    Returns:
        A new batch; `others` if its type or shapes differ.
    """
    shapes = [tensor.shape for tensor in tensors_of(value)]
    other_shapes = [tensor.shape for tensor in tensors_of(others)]
    if type(value) is not type(others) or shapes != other_shapes:
        return others
    return value.put(members, others.select(members))


def first_tensor(value: Batch) -> Tensor:
    """Return the first tensor of a dataclass or of its nested batches.

    Raises:
        StopIteration: If there is no tensor.
    """
    return next(tensors_of(value))


def tensors_of(value: Any) -> Iterator[Tensor]:
    """Yield the tensors of a value and of its nested batches, tuples and lists."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Batch):
        for field in fields(cast(Any, value)):
            yield from tensors_of(getattr(value, field.name))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from tensors_of(part)


def find_tensor_fault(
    what: str,
    values: Any,
    dtype: torch.dtype,
    shape: tuple[int, ...],
    device: torch.device,
) -> str:
    """Return a message if a value is not the expected tensor, or empty text.

    Args:
        what: the value in the message.
        values: the value.
        dtype: expected dtype.
        shape: expected shape.
        device: expected device.
    """
    expected = f"{dtype} of shape {list(shape)} on {device}"
    got = type(values).__name__
    if isinstance(values, Tensor):
        got = f"{values.dtype} of shape {list(values.shape)} on {values.device}"
    return "" if got == expected else f"Expected {what} as {expected}, got {got}."
