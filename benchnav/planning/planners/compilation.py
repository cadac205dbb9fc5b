"""Compilation of rollouts by `torch.compile`.

`torch.compile` fuses a rollout's many small operations, which saves time if there are
many rollouts. It needs a C++ compiler at run time. Without a compiler, the same code
runs uncompiled, and a line on stderr reports it. The environment variable
`TORCH_COMPILE_DISABLE=1` turns compilation off.

Compiled results differ from uncompiled ones in their last bits, and compiled code is
much faster. Hence compilation depends only on a planner's settings and the device, and
not on the number of episodes or on earlier compilations in the process.
"""

import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch

R = TypeVar("R")


def can_compile() -> bool:
    """Return whether a C++ compiler is available and compilation is not turned off."""
    names = (os.environ.get("CXX", ""), "g++", "clang++")
    has_compiler = any(shutil.which(name) for name in names if name)
    return not _is_switched_off() and has_compiler


def _is_switched_off() -> bool:
    """Return whether PyTorch's compilation is turned off.

    The function does not import PyTorch's compiler, since the import takes a second.
    """
    if "torch._dynamo" in sys.modules:
        return bool(torch._dynamo.config.disable)
    return os.environ.get("TORCH_COMPILE_DISABLE") == "1"


def worth_compiling(rollouts: int, min_rollouts: int, device: torch.device) -> bool:
    """Return whether a number of rollouts per episode should be compiled."""
    return device.type == "cuda" or rollouts >= min_rollouts


class Fused(Generic[R]):
    """A pure function that is compiled at its first call if possible.

    It is compiled once for a single episode and once for any larger number of episodes,
    so that the number of episodes may decrease. If the compilation of one function
    fails, other functions are still compiled.

    Args:
        function: function whose arguments are tensors, named tuples of tensors, and
            other values. Its first argument is a tensor or begins with one. It must not
            modify its arguments.
        rollouts: number of rollouts per episode in a call.
        min_rollouts: minimum number of rollouts per episode for which a function is
            compiled on the CPU.
        batched: indices of the arguments whose first dimension counts the episodes;
            each item of a tuple counts as an argument.
    """

    def __init__(
        self,
        function: Callable[..., R],
        rollouts: int,
        min_rollouts: int,
        batched: tuple[int, ...] = (),
    ) -> None:
        """Store the function; nothing is compiled yet."""
        self._function = function
        self._rollouts = rollouts
        self._min_rollouts = min_rollouts
        self._batched = batched
        self._fused: Callable[..., R] | None = None
        self._seen: set[tuple[object, ...]] = set()
        self.compiled: bool | None = None
        """Whether the function runs compiled; None before the first call."""

    def __call__(self, *args: Any) -> R:
        """Call the function, compiled if this is possible and saves time."""
        if self.compiled is False:
            return self._function(*args)
        items: list[Any] = []
        for arg in args:
            items.extend(arg if isinstance(arg, tuple) else (arg,))
        if self.compiled is None and not self._pays(items[0].device):
            self.compiled = False
            return self._function(*args)
        signature = self._signature(items)
        kinds = [type(arg) for arg in args]
        try:
            result = self._call(kinds, items, signature)
        except (
            torch._dynamo.exc.TorchDynamoException,
            torch._dynamo.exc.FailOnRecompileLimitHit,
        ) as error:
            self.compiled = False
            reason = str(error).strip().splitlines()[0]
            print(
                "benchnav: compilation failed, so rollouts run uncompiled and several "
                f"times slower: {reason}",
                file=sys.stderr,
            )
            return self._function(*args)
        self._seen.add(signature)
        self.compiled = True
        return result

    def _pays(self, device: torch.device) -> bool:
        """Return whether the function should be compiled on a device."""
        if _is_switched_off():
            return False
        return worth_compiling(self._rollouts, self._min_rollouts, device)

    def _call(
        self, kinds: list[type], items: list[Any], signature: tuple[object, ...]
    ) -> R:
        """Run the compiled function; compile it first if the signature is new."""
        if self._fused is None:
            function = _of_items(self._function, kinds)
            self._fused = torch.compile(function, dynamic=False, fullgraph=True)
        if signature in self._seen:
            try:
                return self._fused(*items)
            except torch._dynamo.exc.FailOnRecompileLimitHit:
                # Something changed that the signature does not include.
                pass
        is_checked = not all(map(_is_ours, items))
        with _compiling(is_checked):
            for index in self._batched:
                item = items[index]
                # A single episode has its own compiled code.
                if item is not None and len(item) > 1:
                    torch._dynamo.maybe_mark_dynamic(item, 0)
            return self._fused(*items)

    def _signature(self, items: list[Any]) -> tuple[object, ...]:
        """Return the properties of a call that require separate compilation.

        They are the shapes, dtypes and devices of tensors, the values of other
        arguments, PyTorch's modes and the number of threads.
        """
        properties: list[object] = [
            torch.is_inference_mode_enabled(),
            torch.is_grad_enabled(),
            torch.get_num_threads(),
        ]
        for index, item in enumerate(items):
            if not isinstance(item, torch.Tensor):
                properties.append(_key(item))
                continue
            shape: tuple[object, ...] = item.shape
            if index in self._batched:
                shape = (len(item) > 1, item.shape[1:])
            properties.append((shape, item.dtype, item.device))
        return tuple(properties)


def _of_items(function: Callable[..., R], kinds: list[type]) -> Callable[..., R]:
    """Return a function that receives the items of tuples instead of the tuples.

    PyTorch checks single tensors faster than tuples at each call.

    Args:
        function: function of arguments, some of which are named tuples.
        kinds: types of the arguments; each item of a named tuple becomes an argument.
    """
    sizes = [len(kind._fields) if issubclass(kind, tuple) else 0 for kind in kinds]  # type: ignore[attr-defined]

    def call(*items: Any) -> R:
        args: list[Any] = []
        first = 0
        for kind, size in zip(kinds, sizes, strict=True):
            arg = items[first]
            if size:
                arg = kind(*items[first : first + size])
            args.append(arg)
            first += size or 1
        return function(*args)

    return call


@contextmanager
def _compiling(checked: bool) -> Iterator[None]:
    """Set PyTorch's options for compilation.

    Setting them takes longer than a rollout, so they are set only for compilation.

    Args:
        checked: whether compiled code checks the indices that it computes.
    """
    import torch._inductor.config  # Imported here, since the import takes a second.

    # PyTorch warns if a CUDA toolkit has no GPU, which does not matter on the CPU.
    notices = logging.getLogger("torch.utils.cpp_extension")
    level = notices.level
    notices.setLevel(logging.ERROR)
    try:
        with (
            # PyTorch's default limit of a few shapes per process would make results
            # depend on earlier runs.
            torch._dynamo.config.patch(
                recompile_limit=sys.maxsize,
                accumulated_recompile_limit=sys.maxsize,
                fail_on_recompile_limit_hit=True,
                suppress_errors=False,
            ),
            torch._inductor.config.patch(assert_indirect_indexing=checked),
        ):
            yield
    finally:
        notices.setLevel(level)


def _key(arg: object) -> object:
    """Return an argument, or its id if it cannot be hashed."""
    try:
        hash(arg)
    except TypeError:
        return id(arg)
    return arg


def _is_ours(arg: object) -> bool:
    """Return whether the class of an argument belongs to PyTorch, Python or benchnav.

    With such arguments, all computed indices are valid. A custom robot or objective may
    compute invalid indices, so they are checked, which takes a third of the time.
    """
    package = type(arg).__module__.split(".")[0]
    return package in ("torch", "builtins", "benchnav")
