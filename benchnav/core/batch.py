"""Batches: frozen dataclasses of tensors whose first dimension indexes the elements.

Elements are episodes or maps. Letters in shapes: B elements of a batch; M selected
elements.
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
        """Set a short `__repr__`, which the dataclass decorator keeps."""
        super().__init_subclass__(**kwargs)
        cls.__repr__ = short_repr  # type: ignore[method-assign]

    def select(self, members: Tensor) -> Self:
        """Return a batch of selected elements; an index may repeat.

        Args:
            members: indices of the elements, int64, shape [M].
        """

        def rows_of(values: Tensor) -> Tensor:
            return values[members]

        def select_nested(batch: Any) -> Any:
            return batch.select(members)  # a nested batch may override this method

        return _mapped(self, rows_of, select_nested, ())

    def put(self, members: Tensor, others: Self) -> Self:
        """Return a batch with some elements replaced.

        Args:
            members: indices of the elements to replace, int64, shape [M].
            others: the M new elements.
        """

        def put_rows(old: Tensor, new: Tensor) -> Tensor:
            return old.index_copy(0, members, new)

        return map_tensors(self, put_rows, others)

    def clone(self) -> Self:
        """Return a copy of the batch with copies of all tensors."""
        return map_tensors(self, torch.clone)

    def to(self, device: torch.device | str) -> Self:
        """Return the batch with all tensors on a device."""
        return map_tensors(self, lambda values: values.to(device))


def map_tensors(value: Value, change: Callable[..., Tensor], *others: Value) -> Value:
    """Apply a function to each tensor of a dataclass.

    It is also applied to tensors in nested batches, tuples of batches and mappings.
    Other fields are unchanged.

    Args:
        value: the dataclass.
        change: function of a tensor and of the corresponding tensors of `others`; it
            returns the new tensor.
        others: dataclasses of the same type as `value`.
    """

    def map_nested(batch: Any, *other_batches: Any) -> Any:
        return map_tensors(batch, change, *other_batches)

    return _mapped(value, change, map_nested, others)


def _mapped(
    value: Value,
    change: Callable[..., Tensor],
    change_nested: Callable[..., Any],
    others: Sequence[Any],
) -> Value:
    """Apply `change` to each tensor and `change_nested` to each nested batch."""
    batch: Any = value
    changes = {}
    for field in fields(batch):
        values = [getattr(dataclass, field.name) for dataclass in (batch, *others)]
        changes[field.name] = _changed(values, change, change_nested)
    return cast(Value, replace(batch, **changes))


def _changed(
    values: Sequence[Any],
    change: Callable[..., Tensor],
    change_nested: Callable[..., Any],
) -> Any:
    """Return the new value of a field from its values in all dataclasses."""
    first = values[0]
    if isinstance(first, Tensor):
        return change(*values)
    if isinstance(first, Batch):
        return change_nested(*values)
    if isinstance(first, tuple) and first and isinstance(first[0], Batch):
        return tuple(change_nested(*batches) for batches in zip(*values, strict=True))
    if isinstance(first, Mapping):
        new_mapping = {}
        for key in first:
            items = [mapping[key] for mapping in values]
            new_mapping[key] = _changed(items, change, change_nested)
        return new_mapping
    return first


def put_if_alike(value: Value, members: Tensor, others: Value) -> Value:
    """Replace selected elements of a batch by the same elements of another batch.

    Args:
        value: batch of B elements.
        members: indices of the elements to replace, int64, shape [M].
        others: batch of B elements that contains the new elements.

    Returns:
        A new batch. If `others` has a different type or different shapes, `others`.
    """
    shapes = [tensor.shape for tensor in tensors_of(value)]
    other_shapes = [tensor.shape for tensor in tensors_of(others)]
    if type(value) is not type(others) or shapes != other_shapes:
        return others
    return value.put(members, others.select(members))


def have_same_structure(first: Any, second: Any) -> bool:
    """Return whether two values differ at most in the numbers of their tensors."""
    if isinstance(first, Tensor) and isinstance(second, Tensor):
        return first.shape == second.shape
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(
            map(have_same_structure, first, second)
        )
    if isinstance(first, Batch) and type(first) is type(second):
        names = [field.name for field in fields(cast(Any, first))]
        return all(
            have_same_structure(getattr(first, name), getattr(second, name))
            for name in names
        )
    return bool(first == second)


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
    """Return a message if a value is not a tensor as expected; otherwise empty text.

    Args:
        what: name of the value in the message.
        values: value to check.
        dtype: expected dtype.
        shape: expected shape.
        device: expected device.
    """
    expected = f"{dtype} of shape {list(shape)} on {device}"
    got = type(values).__name__
    if isinstance(values, Tensor):
        got = f"{values.dtype} of shape {list(values.shape)} on {values.device}"
    if got == expected:
        return ""
    return f"Expected {what} as {expected}, got {got}."
