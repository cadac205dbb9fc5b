"""A device that is not there: it computes on the CPU, and otherwise behaves as a GPU
does.

A tensor of this device meets tensors of the CPU only where PyTorch lets those of a GPU
do so, and what makes a program wait for a GPU is counted. So code can be tried for
another device on a machine that has none.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

backend = pytest.importorskip("torch.utils.backend_registration")
if not hasattr(backend, "_setup_privateuseone_for_python_backend"):
    pytest.skip(
        "this PyTorch cannot be given a device in Python", allow_module_level=True
    )
backend._setup_privateuseone_for_python_backend("elsewhere")
torch.elsewhere.get_amp_supported_dtype = lambda: [torch.bfloat16]  # type: ignore[attr-defined]

ELSEWHERE = torch.device("elsewhere", 0)
aten = torch.ops.aten
_COPIES = (aten._to_copy.default, aten.copy_.default)
_TAKE_INDICES_OF_THE_CPU = (aten.index.Tensor, aten.index_put_.default)
_WAITING = {
    "_local_scalar_dense", "nonzero", "masked_select", "equal", "bincount", "_unique2", "unique_consecutive",
}  # fmt: skip

waits: list[str] = []  # what a program has waited for


class Far(torch.Tensor):
    """A tensor of that device, whose numbers are in `inner`."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "Far":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=ELSEWHERE,
        )
        made.inner = inner
        return made

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _compute(func, args, kwargs or {})

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Far({self.inner})"

    def tolist(self) -> Any:
        waits.append("tolist")
        return self.inner.tolist()


class _Mode(TorchDispatchMode):
    """Makes tensors there when they are asked for."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _compute(func, args, kwargs or {})


@contextmanager
def elsewhere() -> Iterator[torch.device]:
    """The device, as long as it is there."""
    waits.clear()
    # So a module can be moved there: a tensor of the CPU cannot become one of ours in
    # place.
    torch.__future__.set_swap_module_params_on_conversion(True)
    # Tensors of our kind cannot be made in inference mode.
    inference_mode, torch.inference_mode = torch.inference_mode, torch.no_grad  # type: ignore[misc, assignment]
    try:
        with _Mode():
            yield ELSEWHERE
    finally:
        torch.inference_mode = inference_mode  # type: ignore[misc]
        torch.__future__.set_swap_module_params_on_conversion(False)


def _compute(func: Any, args: Any, kwargs: Any) -> Any:
    tensors = [
        value
        for value in tree_leaves((args, kwargs))
        if isinstance(value, torch.Tensor)
    ]
    far = [value for value in tensors if isinstance(value, Far)]
    near = [value for value in tensors if not isinstance(value, Far) and value.dim()]
    if func in _TAKE_INDICES_OF_THE_CPU and isinstance(args[0], Far):
        near = [value for value in near if value.dtype not in (torch.int64, torch.bool)]
    if far and near and func not in _COPIES:
        raise RuntimeError(f"Expected all tensors on one device, got two in {func}.")
    asked = kwargs.get("device")
    goes = bool(far) if asked is None else torch.device(asked).type == ELSEWHERE.type
    generator = kwargs.get("generator")
    if goes and generator is not None and generator.device.type == "cpu":
        raise RuntimeError(
            f"Expected a generator of the device, got one of the CPU in {func}."
        )
    crosses = func in _COPIES and bool(far) != goes
    by_mask = func in _TAKE_INDICES_OF_THE_CPU and any(
        value.dtype == torch.bool for value in tensors[1:]
    )
    if crosses or (
        far and (func._schema.name.removeprefix("aten::") in _WAITING or by_mask)
    ):
        waits.append(str(func))
    result = func(*tree_map(_here, args), **tree_map(_here, kwargs))
    if func._schema.is_mutable and args and isinstance(args[0], torch.Tensor):
        return args[0]
    return _there(result, goes)


def _here(value: Any) -> Any:
    if isinstance(value, Far):
        return value.inner
    return (
        torch.device("cpu")
        if isinstance(value, torch.device) and value.type == ELSEWHERE.type
        else value
    )


def _there(result: Any, goes: bool) -> Any:
    def move(value: Any) -> Any:
        return Far(value) if goes and isinstance(value, torch.Tensor) else value

    return tree_map(move, result)


def _empty(size: Any, stride: Any, dtype: Any = None, **_: Any) -> Far:
    return Far(torch.empty_strided(size, stride, dtype=dtype))


def _copy(
    source: torch.Tensor, target: torch.Tensor, non_blocking: bool = False
) -> torch.Tensor:
    waits.append("copy")
    _here(target).copy_(_here(source))
    return target


# `new_tensor` goes past the mode.
_library = torch.library.Library("aten", "IMPL")
_library.impl("empty_strided", _empty, "PrivateUse1")
_library.impl("_copy_from", _copy, "PrivateUse1")
