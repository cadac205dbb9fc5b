"""Compilation of rollouts by `torch.compile`.

`torch.compile` fuses a rollout's many small operations, which saves time if there are
many rollouts. It needs a C++ compiler at run time. Without a compiler the same code runs
eagerly, and one line reports it. PyTorch's switch `TORCH_COMPILE_DISABLE=1` turns
compilation off.

Whether a planner runs compiled depends only on its settings and the device. It depends
neither on the number of episodes of a batch nor on earlier compilations in the process,
since compiled and eager results differ in their last bits, and compiled code is much
faster.
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
    """Return whether compilation is available.

    It needs a C++ compiler, and PyTorch's switch must not be off.
    """
    names = (os.environ.get("CXX", ""), "g++", "clang++")
    has_compiler = any(shutil.which(name) for name in names if name)
    return not _is_switched_off() and has_compiler


def _is_switched_off() -> bool:
    """Return whether PyTorch's compilation is switched off.

    PyTorch's compiler is not imported for this, since its import takes a second.
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
    so that a batch may shrink. Objects are independent: a failed compilation of one
    does not affect others.

    Args:
        function: function of tensors and named tuples of tensors, the first argument a
            tensor; it must not modify its arguments.
        rollouts: number of rollouts of an episode in a call.
        min_rollouts: minimum number that is worth the seconds of compilation. Fewer run
            eagerly, in a time that hardly depends on their number.
        batched: indices of the arguments whose first dimension is that of the episodes;
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
        """Call the function, compiled if that saves time and is possible."""
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
                f"benchnav: running uncompiled, several times slower: {reason}",
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
        """Run the compiled function, with options for compilation if it is needed."""
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

        They are shapes, dtypes and devices of tensors, other arguments, and PyTorch's
        modes.
        """
        parts: list[object] = [
            torch.is_inference_mode_enabled(),
            torch.is_grad_enabled(),
            torch.get_num_threads(),
        ]
        for index, item in enumerate(items):
            if not isinstance(item, torch.Tensor):
                parts.append(_key(item))
                continue
            shape: tuple[object, ...] = item.shape
            if index in self._batched:
                shape = (len(item) > 1, item.shape[1:])
            parts.append((shape, item.dtype, item.device))
        return tuple(parts)


def _of_items(function: Callable[..., R], kinds: list[type]) -> Callable[..., R]:
    """Return a function of single items, whose guards are cheaper than those of tuples.

    Args:
        function: function of arguments of these types.
        kinds: types of the arguments; a named tuple is replaced by its items.
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
        checked: whether computed indices are checked.
    """
    import torch._inductor.config  # imported here, since its import takes a second

    # It warns of a CUDA toolkit without a GPU, which does not matter on the CPU.
    notices = logging.getLogger("torch.utils.cpp_extension")
    level = notices.level
    notices.setLevel(logging.ERROR)
    try:
        with (
            # PyTorch's own limit, a few shapes in a process, would make results depend
            # on earlier runs.
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
    """Return an argument, or its id if it cannot be hashed, as a robot with a list."""
    try:
        hash(arg)
    except TypeError:
        return id(arg)
    return arg


def _is_ours(arg: object) -> bool:
    """Return whether PyTorch or this package defines an argument's class.

    Such arguments compute only valid indices. A custom robot or objective may compute
    invalid ones. Checking each index takes a third of the time.
    """
    package = type(arg).__module__.split(".")[0]
    return package in ("torch", "builtins", "benchnav")
