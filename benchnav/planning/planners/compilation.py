"""Compilation of rollouts by `torch.compile`.

`torch.compile` fuses a rollout's many small operations, which pays if there are many
rollouts. It needs a C++ compiler at run time; without one the same code runs eagerly,
and one line reports it. PyTorch's own switch `TORCH_COMPILE_DISABLE=1` turns it off.

Whether a planner runs compiled only depends on its settings and the device. It does not
depend on the number of episodes of a batch, nor on what the process compiled before,
since compiled and eager results differ in their last bits and much in speed.
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

    PyTorch's switch is not off, and there is a C++ compiler.
    """
    names = (os.environ.get("CXX", ""), "g++", "clang++")
    has_compiler = any(shutil.which(name) for name in names if name)
    return not _is_switched_off() and has_compiler


def _is_switched_off() -> bool:
    """Return whether PyTorch's compilation is switched off.

    Its compiler takes a second to import, and is not imported for this.
    """
    if "torch._dynamo" in sys.modules:
        return bool(torch._dynamo.config.disable)
    return os.environ.get("TORCH_COMPILE_DISABLE") == "1"


def worth_compiling(rollouts: int, min_rollouts: int, device: torch.device) -> bool:
    """Return whether that number of rollouts per episode is to be compiled."""
    return device.type == "cuda" or rollouts >= min_rollouts


class Fused(Generic[R]):
    """A pure function that is compiled at its first call, or runs eagerly if it cannot
    be.

    It is compiled once for a single episode and once for any number of them, so that a
    batch may shrink. Each object decides for itself: one that cannot be compiled does
    not affect others.

    Args:
        function: takes and returns tensors, single or in named tuples, the first of
            them a tensor; it must not change them.
        rollouts: number of rollouts of an episode in a call.
        min_rollouts: minimum number that is worth the seconds of compilation. Fewer run
            eagerly, which takes the same time however few they are.
        batched: indices of the arguments whose first dimension is that of the episodes,
            each item of a tuple counted.
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
        """Whether it runs compiled; None before the first call."""

    def __call__(self, *args: Any) -> R:
        """Call the function, compiled where that pays and is possible."""
        if self.compiled is False:
            return self._function(*args)
        items: list[Any] = []
        for arg in args:
            items.extend(arg if isinstance(arg, tuple) else (arg,))
        if self.compiled is None and not self._pays(items[0].device):
            self.compiled = False
            return self._function(*args)
        signature = self._signature(items)
        try:
            result = self._call([type(arg) for arg in args], items, signature)
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
        """Return whether the function is to be compiled on a device."""
        if _is_switched_off():
            return False
        return worth_compiling(self._rollouts, self._min_rollouts, device)

    def _call(
        self, kinds: list[type], items: list[Any], signature: tuple[object, ...]
    ) -> R:
        """Run the compiled function; a new signature under the settings of compilation."""
        if self._fused is None:
            self._fused = torch.compile(
                _of_items(self._function, kinds), dynamic=False, fullgraph=True
            )
        if signature in self._seen:
            try:
                return self._fused(*items)
            except torch._dynamo.exc.FailOnRecompileLimitHit:
                # Something changed that the signature does not include.
                pass
        with _compiling(checked=not all(map(_is_ours, items))):
            for index in self._batched:
                # The number of episodes may be any, except one.
                if items[index] is not None and len(items[index]) > 1:
                    torch._dynamo.maybe_mark_dynamic(items[index], 0)
            return self._fused(*items)

    def _signature(self, items: list[Any]) -> tuple[object, ...]:
        """Return the properties of a call that it is compiled for.

        They are shapes, dtypes and devices of tensors, other arguments, and PyTorch's
        modes.
        """
        parts: list[object] = [
            torch.is_inference_mode_enabled(),
            torch.is_grad_enabled(),
            torch.get_num_threads(),
        ]
        for index, item in enumerate(items):
            if isinstance(item, torch.Tensor):
                shape = (
                    (len(item) > 1, item.shape[1:])
                    if index in self._batched
                    else item.shape
                )
                parts.append((shape, item.dtype, item.device))
            else:
                parts.append(_key(item))
        return tuple(parts)


def _of_items(function: Callable[..., R], kinds: list[type]) -> Callable[..., R]:
    """Return a function of single items, whose guards are cheaper than those of tuples.

    Args:
        function: takes arguments of these kinds.
        kinds: types of its arguments; a named tuple stands for its items.
    """
    sizes = [len(kind._fields) if issubclass(kind, tuple) else 0 for kind in kinds]  # type: ignore[attr-defined]

    def call(*items: Any) -> R:
        args: list[Any] = []
        first = 0
        for kind, size in zip(kinds, sizes, strict=True):
            args.append(kind(*items[first : first + size]) if size else items[first])
            first += size or 1
        return function(*args)

    return call


@contextmanager
def _compiling(checked: bool) -> Iterator[None]:
    """Set PyTorch's options for compilation.

    To set them takes longer than a rollout, so they are only set for it.

    Args:
        checked: whether computed indices are checked.
    """
    import torch._inductor.config  # imported here: it takes a second

    # It would warn of a CUDA toolkit without a GPU, which does not matter on the CPU.
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
    """Return an argument if it has a hash; else its id, as for a frozen robot with a list."""
    try:
        hash(arg)
    except TypeError:
        return id(arg)
    return arg


def _is_ours(arg: object) -> bool:
    """Return whether an argument is of PyTorch or this package, whose indices are valid.

    A user's robot or objective may compute others. To check each index takes a third of
    the time.
    """
    return type(arg).__module__.split(".")[0] in ("torch", "builtins", "benchnav")
