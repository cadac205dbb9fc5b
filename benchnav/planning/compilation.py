"""The one place that decides what is compiled.

`torch.compile` fuses a rollout's many small operations, which pays once batches are large. It needs
a C++ compiler at run time; without one the same code runs eagerly, and one line says so. PyTorch's
own switch `TORCH_COMPILE_DISABLE=1` turns it off.
"""

import logging
import sys
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

# Under this many parallel rollouts compiling takes longer than it saves in an episode.
WORTH_COMPILING = 40_000

_state = {"available": True}


def worth_compiling(rollouts: int, device: torch.device) -> bool:
    """Tells whether a step over this many parallel rollouts is to be compiled."""
    return device.type == "cuda" or rollouts >= WORTH_COMPILING


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a pure function at its first call; falls back to it where that cannot be done.

    Args:
        function: takes and returns tensors; it must not change its arguments.
    """
    fused = torch.compile(function, dynamic=False)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if _state["available"]:
            # It would tell of a CUDA toolkit without a GPU, which is no concern of a rollout on the CPU.
            notices = logging.getLogger("torch.utils.cpp_extension")
            level = notices.level
            notices.setLevel(logging.ERROR)
            try:
                return fused(*args, **kwargs)
            except (torch._dynamo.exc.TorchDynamoException, torch._inductor.exc.InductorError) as error:
                _state["available"] = False
                reason = str(error).strip().splitlines()[0]
                print(f"benchnav: running uncompiled, several times slower: {reason}", file=sys.stderr)
            finally:
                notices.setLevel(level)
        return function(*args, **kwargs)

    return call
