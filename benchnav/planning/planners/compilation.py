"""The one place that decides what is compiled.

`torch.compile` fuses a rollout's many small operations, which pays once there are many rollouts. It needs
a C++ compiler at run time; without one the same code runs eagerly, and one line says so. PyTorch's own
switch `TORCH_COMPILE_DISABLE=1` turns it off.

Whether a planner runs compiled depends on its settings and on the device alone: not on how many episodes
a batch has, nor on what the process compiled before, since compiled and eager results differ in their last
bits and much in speed.
"""

import logging
import os
import shutil
import sys
from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

# Under this many parallel rollouts compiling takes longer than it saves in an episode.
_WORTH_ROLLOUTS = 40_000
# Episodes that are taken to run in parallel, however many do.
_EPISODES = 20


def can_compile() -> bool:
    """Tells whether anything is compiled here: PyTorch's switch is not off, and there is a C++ compiler."""
    compilers = (os.environ.get("CXX", ""), "g++", "clang++")
    return not torch._dynamo.config.disable and any(shutil.which(name) for name in compilers if name)


def worth_compiling(samples: int, device: torch.device) -> bool:
    """Tells whether rollouts of so many samples an episode are to be compiled."""
    return device.type == "cuda" or samples * _EPISODES >= _WORTH_ROLLOUTS


class Fused(Generic[P, R]):
    """A pure function that is compiled at its first call, or runs as it is where that cannot be done.

    Each holds its own verdict: one that cannot be compiled leaves all others as they are.

    Args:
        function: takes and returns tensors, one of them first; it must not change its arguments.
        samples: rollouts an episode that a call is for.
    """

    def __init__(self, function: Callable[P, R], samples: int) -> None:
        """Keeps the function; nothing is compiled yet."""
        self._function, self._samples = function, samples
        self._fused: Callable[P, R] | None = None
        self.compiled: bool | None = None
        """Whether it runs compiled; None before the first call."""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Calls the function."""
        if self.compiled is None and not self._wanted(args[0]):
            self.compiled = False
        if self.compiled is False:
            return self._function(*args, **kwargs)
        if self._fused is None:
            self._fused = torch.compile(self._function, dynamic=False, fullgraph=True)
        # It would tell of a CUDA toolkit without a GPU, which is no concern of a rollout on the CPU.
        notices = logging.getLogger("torch.utils.cpp_extension")
        level = notices.level
        notices.setLevel(logging.ERROR)
        try:
            # PyTorch's own limit, a few shapes in a process, would make results depend on earlier runs.
            with torch._dynamo.config.patch(
                recompile_limit=sys.maxsize,
                accumulated_recompile_limit=sys.maxsize,
                fail_on_recompile_limit_hit=True,
                suppress_errors=False,
            ):
                result = self._fused(*args, **kwargs)
        except torch._dynamo.exc.TorchDynamoException as error:
            self.compiled = False
            reason = str(error).strip().splitlines()[0]
            print(f"benchnav: running uncompiled, several times slower: {reason}", file=sys.stderr)
            return self._function(*args, **kwargs)
        finally:
            notices.setLevel(level)
        self.compiled = True
        return result

    def _wanted(self, example: object) -> bool:
        assert isinstance(example, torch.Tensor)
        return worth_compiling(self._samples, example.device) and not torch._dynamo.config.disable
