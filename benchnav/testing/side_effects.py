"""Watching a call: what it answers, and what it did to its arguments and to the global generators.

Used by the contract of planners; nothing here knows what a planner is.
"""

import pickle
import random
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core.errors import BenchnavError

NOTHING = object()  # what a call that raised has answered


def watch(what: str, act: Callable[[], Any], **given: Any) -> tuple[Any, list[str]]:
    """Calls, and tells what the call did that it should not.

    Args:
        what: its name, for people.
        act: the call.
        given: its arguments by name; tensors, arrays, generators and numbers in them are compared before
            and after, however deep they lie.

    Returns:
        The answer, `NOTHING` where it raised; and the breaches, a line each.
    """
    before, states = dict(_leaves(given)), _generators()
    answer, breaches = NOTHING, []
    try:
        answer = act()
    except Exception as error:
        text = " ".join(str(error).split())
        named = text if isinstance(error, BenchnavError) else f"{type(error).__name__}: {text}"
        breaches.append(f"Expected an answer from `{what}`, got {named}")
    after = dict(_leaves(given))
    changed = [name for name, leaf in before.items() if not _same_leaf(leaf, after.get(name, NOTHING))]
    if changed:
        listed = ", ".join(changed[:3]) + (", …" if len(changed) > 3 else "")
        breaches.append(f"Expected `{what}` to leave its arguments as they were, got another {listed}.")
    breaches += [
        f"Expected {whose} global generator to be left alone, got it changed. Draw from the one given to `init`."
        for whose, state in _generators().items()
        if states.get(whose, state) != state
    ]
    return answer, breaches


def _leaves(value: Any, name: str = "", seen: set[int] | None = None) -> Iterator[tuple[str, Any]]:
    """Lists copies of all tensors, arrays, generators and numbers within a value, by where they are."""
    seen = set() if seen is None else seen
    if isinstance(value, bool | int | float | str | None):
        yield name, value
        return
    if id(value) in seen or isinstance(value, type):
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        yield name, value.detach().clone()
    elif isinstance(value, np.ndarray):
        yield name, value.copy()
    elif isinstance(value, torch.Generator):
        yield name, value.get_state()
    elif isinstance(value, np.random.Generator):
        yield name, str(value.bit_generator.state)
    else:
        parts: Mapping[Any, Any] = getattr(value, "__dict__", {})
        if isinstance(value, Mapping):
            parts = value
        elif isinstance(value, list | tuple):
            parts = dict(enumerate(value))
        for key, part in list(parts.items()):
            yield from _leaves(part, f"{name}.{key}" if name else str(key), seen)


def _same_leaf(first: Any, second: Any) -> bool:
    if isinstance(first, Tensor):
        return isinstance(second, Tensor) and same(first, second)
    if isinstance(first, np.ndarray):
        return isinstance(second, np.ndarray) and first.tobytes() == second.tobytes()
    return bool(first == second) or (first != first and second != second)


def same(first: Tensor, second: Tensor) -> bool:
    """Tells whether two tensors hold the same bits of meaning: NaN equals NaN."""
    if first.shape != second.shape or first.dtype != second.dtype:
        return False
    return bool(((first == second) | (first.isnan() & second.isnan())).all())


def _generators() -> dict[str, bytes]:
    """States of the global generators, in a form that `==` compares."""
    states = {
        "Python's": pickle.dumps(random.getstate()),
        "NumPy's": pickle.dumps(np.random.get_state()),  # noqa: NPY002
        "PyTorch's": bytes(torch.random.get_rng_state().numpy()),
    }
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        states["CUDA's"] = bytes(torch.cuda.get_rng_state().numpy())
    return states
