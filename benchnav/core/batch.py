"""Batches: frozen dataclasses of tensors whose first dimension is that of the members,
episodes or maps.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Self, TypeVar, cast

import torch
from torch import Tensor

from benchnav.core.short_repr import short_repr

Value = TypeVar("Value", bound=Any)


class Batch:
    """The base of dataclasses whose tensors, and those of the batches in them, have the
    members first.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Give each dataclass the short representation, which its decorator keeps."""
        super().__init_subclass__(**kwargs)
        cls.__repr__ = short_repr  # type: ignore[method-assign]

    def select(self, members: Tensor) -> Self:
        """Keeps some members, by index, int64, shape [M]; one may be taken more than
        once.
        """
        # A batch in it keeps them as it does by itself.
        return _mapped(
            self,
            lambda values: values[members],
            lambda inner: inner.select(members),
            (),
        )

    def put(self, members: Tensor, others: Self) -> Self:
        """Puts M members in the places of others, by index, int64, shape [M]; this one
        is not changed.
        """
        return map_tensors(
            self, lambda old, new: old.index_copy(0, members, new), others
        )

    def clone(self) -> Self:
        """A copy that shares no tensor."""
        return map_tensors(self, torch.clone)

    def to(self, device: torch.device | str) -> Self:
        """The same on a device."""
        return map_tensors(self, lambda values: values.to(device))


def map_tensors(value: Value, change: Callable[..., Tensor], *others: Value) -> Value:
    """Changes each tensor of a dataclass, and of the batches, tuples of batches and
    mappings in it; all else stays.

    Args:
        value: the dataclass.
        change: is given a tensor, and those that have its place in the others.
        others: more of the same kind.
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
    """Changes each tensor by `change` and each batch by `inner`."""
    given: Any = value
    names = [each.name for each in fields(given)]
    found = {
        n: _changed(
            getattr(given, n), change, inner, [getattr(one, n) for one in others]
        )
        for n in names
    }
    return cast(Value, replace(given, **found))


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
        return tuple(inner(own, *same) for own, *same in zip(first, *rest, strict=True))
    if isinstance(first, Mapping):
        return {
            key: _changed(own, change, inner, [other[key] for other in rest])
            for key, own in first.items()
        }
    return first


def put_if_alike(value: Value, members: Tensor, others: Value) -> Value:
    """Puts some members of another batch in the same places of this one; of an unlike
    kind or size, gives the other.

    Args:
        value: of B members; it is not changed.
        members: which ones, by index, int64.
        others: of B members too.
    """
    alike = [[own.shape for own in _tensors(each)] for each in (value, others)]
    if type(value) is not type(others) or alike[0] != alike[1]:
        return others
    return value.put(members, others.select(members))


def first_tensor(value: Batch) -> Tensor:
    """The first tensor of a dataclass, the batches and tuples of batches in it
    included.

    Raises:
        StopIteration: it has none.
    """
    return next(_tensors(value))


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    parts = (
        [getattr(value, each.name) for each in fields(cast(Any, value))]
        if isinstance(value, Batch)
        else value
    )
    for part in parts if isinstance(parts, list | tuple) else ():
        yield from _tensors(part)


def find_tensor_fault(
    what: str,
    values: Any,
    dtype: torch.dtype,
    shape: tuple[int, ...],
    device: torch.device,
) -> str:
    """Tells in one line what makes something another tensor than is expected; empty
    where nothing does.
    """
    wanted, got = f"{dtype} of shape {list(shape)} on {device}", type(values).__name__
    if isinstance(values, Tensor):
        got = f"{values.dtype} of shape {list(values.shape)} on {values.device}"
    return "" if got == wanted else f"Expected {what} as {wanted}, got {got}."
