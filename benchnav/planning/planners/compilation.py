"""The one place that decides what is compiled.

`torch.compile` fuses a rollout's many small operations, which pays once there are many
rollouts. It needs a C++ compiler at run time; without one the same code runs eagerly,
and one line says so. PyTorch's own switch `TORCH_COMPILE_DISABLE=1` turns it off.

Whether a planner runs compiled depends on its settings and on the device alone: not on
how many episodes a batch has, nor on what the process compiled before, since compiled
and eager results differ in their last bits and much in speed.
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
    """Tells whether anything is compiled here: PyTorch's switch is not off, and there
    is a C++ compiler.
    """
    compilers = (os.environ.get("CXX", ""), "g++", "clang++")
    return not _is_switched_off() and any(
        shutil.which(name) for name in compilers if name
    )


def _is_switched_off() -> bool:
    """Return whether PyTorch compiles nothing; its compiler, which takes a second to
    import, need not be loaded.
    """
    if "torch._dynamo" in sys.modules:
        return bool(torch._dynamo.config.disable)
    return os.environ.get("TORCH_COMPILE_DISABLE") == "1"


def worth_compiling(rollouts: int, min_rollouts: int, device: torch.device) -> bool:
    """Tells whether so many rollouts an episode are to be compiled."""
    return device.type == "cuda" or rollouts >= min_rollouts


class Fused(Generic[R]):
    """A pure function that is compiled at its first call, or runs as it is where that
    cannot be done.

    It is compiled once for a single episode and once for any number of them, so that a
    batch may shrink. Each
    holds its own verdict: one that cannot be compiled leaves all others as they are.

    Args:
        function: takes and returns tensors, one of them first, alone or in named
            tuples; it must not change them.
        rollouts: how many of an episode a call is for.
        least: so many are worth the seconds that compiling takes. Fewer run eagerly,
            which takes the same time however few they are.
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
        """Keeps the function; nothing is compiled yet."""
        self._function, self._rollouts, self._least, self._batched = (
            function,
            rollouts,
            min_rollouts,
            batched,
        )
        self._fused: Callable[..., R] | None = None
        self._seen: set[tuple[object, ...]] = set()
        self.compiled: bool | None = None
        """Whether it runs compiled; None before the first call."""

    def __call__(self, *args: Any) -> R:
        """Calls the function."""
        if self.compiled is False:
            return self._function(*args)
        items = [
            item for arg in args for item in (arg if isinstance(arg, tuple) else (arg,))
        ]
        if self.compiled is None and (
            _is_switched_off()
            or not worth_compiling(self._rollouts, self._least, items[0].device)
        ):
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

    def _call(
        self, kinds: list[type], items: list[Any], signature: tuple[object, ...]
    ) -> R:
        """Runs what is compiled, for a new signature under the settings of compiling."""
        if self._fused is None:
            self._fused = torch.compile(
                _of_items(self._function, kinds), dynamic=False, fullgraph=True
            )
        if signature in self._seen:
            try:
                return self._fused(*items)
            except torch._dynamo.exc.FailOnRecompileLimitHit:
                # what it was compiled for has changed in what the signature does not
                # tell
                pass
        with _compiling(checked=not all(map(_is_ours, items))):
            for index in self._batched:
                # The number of episodes may be any, except one.
                if items[index] is not None and len(items[index]) > 1:
                    torch._dynamo.maybe_mark_dynamic(items[index], 0)
            return self._fused(*items)

    def _signature(self, items: list[Any]) -> tuple[object, ...]:
        """What a call is compiled for: shapes, dtypes and devices of tensors, the other
        arguments, PyTorch's modes.
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
    """Return a function of single items, whose checks at each call are cheaper than
    those of tuples.

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
    """Settings of PyTorch under which a call is compiled; they take longer to set than
    a rollout, so only then.

    Args:
        checked: whether indices are checked that are computed on the way.
    """
    import torch._inductor.config  # imported here: it takes a second

    # It would tell of a CUDA toolkit without a GPU, which is no concern of a rollout on
    # the CPU.
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
    """An argument by its value where that has a hash; else which object it is, as of a
    frozen robot with a list.
    """
    try:
        hash(arg)
    except TypeError:
        return id(arg)
    return arg


def _is_ours(arg: object) -> bool:
    """Tells what is of PyTorch or of this package, whose lookups keep to the map, from
    a user's robot or objective.

    To check each index takes a third of the time.
    """
    return type(arg).__module__.split(".")[0] in ("torch", "builtins", "benchnav")
