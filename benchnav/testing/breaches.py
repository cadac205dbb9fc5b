"""Tools of all checks: calls that find side effects, comparisons, lists of breaches."""

import pickle
import random
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import find_tensor_fault
from benchnav.core.errors import BenchnavError, ConfigError

SEED = 20240229
NOTHING = object()
"""Placeholder for the result of a call that raised, or whose result is unusable."""


class Breaches:
    """Collection of the breaches of a contract, each listed once with its locations.

    Args:
        kind: kind of the part, as in `check_<kind>`.
        name: name of the part in messages.

    Attributes:
        location: case in which the next breaches are found, such as a size of maps.
    """

    def __init__(self, kind: str, name: str) -> None:
        """Create an empty collection."""
        self._kind = kind
        self._name = name
        self.location = ""
        self._breaches: dict[str, list[str]] = {}
        self._locations: dict[str, None] = {}

    def expect(self, is_fulfilled: bool, breach: str) -> bool:
        """Note a breach unless the expectation is fulfilled; return whether it is."""
        self._locations[self.location] = None
        if not is_fulfilled:
            locations = self._breaches.setdefault(breach, [])
            if self.location and self.location not in locations:
                locations.append(self.location)
        return is_fulfilled

    def is_tensor(
        self, description: str, like: Tensor, shape: tuple[int, ...]
    ) -> Callable[[Any], bool]:
        """Return a function that checks for a tensor of finite numbers.

        The function returns whether its argument is such a tensor, and notes a breach
        if it is not.

        Args:
            description: description of the values in messages.
            like: tensor of the expected dtype and device.
            shape: expected shape.
        """

        def fits(values: Any) -> bool:
            fault = find_tensor_fault(
                description, values, like.dtype, shape, like.device
            )
            if not self.expect(not fault, fault):
                return False
            is_finite = bool(values.isfinite().all())
            return self.expect(
                is_finite, f"Expected finite {description}, got NaN or infinite values."
            )

        return fits

    def batches(self, device: torch.device | str) -> Iterator["Draws"]:
        """Yield sources of arguments of each dtype and leading shape; set `location`."""
        for dtype in (torch.float32, torch.float64):
            for leading in ((6,), (6, 5), (6, 5, 2)):
                self.location = f"*B = {list(leading)}, {dtype}"
                like = torch.zeros(1, dtype=dtype, device=device)
                generator = torch.Generator().manual_seed(SEED)
                yield Draws(leading, like, generator)

    def try_function(
        self,
        name: str,
        function: Callable[..., Any],
        arguments: Mapping[str, Any],
        is_usable: Callable[[Any], bool],
        tolerance: float = 1e-5,
    ) -> Any:
        """Call a pure function of a batch twice, and for its last element only.

        Args:
            name: name of the function in messages.
            function: the function.
            arguments: arguments of the function by name: tensors whose first dimension
                is the batch, or values with a method `select`.
            is_usable: function that returns whether a result can be checked further.
            tolerance: tolerance between results for a single element and for a batch.

        Returns:
            The result; `NOTHING` if it cannot be checked further.
        """
        answer = self.watch(name, lambda: function(**arguments), **arguments)
        if answer is NOTHING or not is_usable(answer):
            return NOTHING
        repeated = function(**arguments)
        self.expect(
            same(repeated, answer),
            f"Expected the same result from `{name}` when called again, got a different "
            "result.",
        )
        last_only = {key: _last(value) for key, value in arguments.items()}
        single = self.watch(name, lambda: function(**last_only))
        expected = _last(answer)
        self.expect(
            same(single, expected, tolerance),
            f"Expected the same result from `{name}` for a single element as in a batch, "
            "got a different result.",
        )
        return answer

    def watch(
        self, function_name: str, function: Callable[[], Any], **arguments: Any
    ) -> Any:
        """Call a function, and note an exception or a side effect.

        Args:
            function_name: name of the function in messages.
            function: function without arguments that makes the call.
            arguments: arguments of the call by name; all tensors, arrays, generators
                and numbers nested in them are compared before and after the call.

        Returns:
            The result; `NOTHING` if the call raised.
        """
        before = dict(_leaves(arguments))
        states_before = _generators()
        answer = NOTHING
        try:
            answer = function()
        except Exception as error:
            got = f"{_text_of(error)} {_origin_of(error)}"
            self.expect(False, f"Expected a result from `{function_name}`, got {got}")
        after = dict(_leaves(arguments))
        changed = []
        for name, leaf in before.items():
            if not same(leaf, after.get(name)):
                changed.append(name)
        listed = ", ".join(changed[:3])
        self.expect(
            not changed,
            f"Expected `{function_name}` to leave its arguments unchanged, got changes "
            f"in {listed}.",
        )
        for owner, state in _generators().items():
            previous = states_before.get(owner, state)
            self.expect(
                previous == state,
                f"Expected {owner} global generator to be unchanged, got a change. "
                "Draw from a generator of your own, or from one that is passed.",
            )
        return answer

    def raise_any(self) -> None:
        """Raise one error that lists all breaches, if there are any.

        Raises:
            ConfigError: If there are breaches.
        """
        if not self._breaches:
            return
        n_locations = sum(bool(location) for location in self._locations)
        listed = ""
        for number, (breach, locations) in enumerate(self._breaches.items(), start=1):
            shown_locations = ", ".join(locations)
            if 1 < len(locations) == n_locations:
                shown_locations = "in all cases"
            listed += f"\n({number}) {breach}"
            if shown_locations:
                listed += f" [{shown_locations}]"
        raise ConfigError(
            f"Expected a {self._kind} that fulfils the contract of "
            f"`benchnav.testing.check_{self._kind}`, got {self._name}, which breaks "
            f"it:{listed}"
        )


@dataclass(frozen=True)
class Draws:
    """A source of random arguments for functions of a batch.

    Args:
        leading: leading dimensions *B of the arguments.
        like: tensor of the arguments' dtype and device.
        generator: random generator.
    """

    leading: tuple[int, ...]
    like: Tensor
    generator: torch.Generator

    def uniform(self, low: Sequence[float], high: Sequence[float]) -> Tensor:
        """Draw uniform numbers between N lower and N upper bounds, shape [*B, N]."""
        lower = self.like.new_tensor(low)
        upper = self.like.new_tensor(high)
        uniform = torch.rand(*self.leading, len(lower), generator=self.generator)
        return lower + (upper - lower) * uniform.to(self.like)


def same(first: Any, second: Any, tolerance: float = 0.0) -> bool:
    """Return whether two values are equal; NaN equals NaN.

    Args:
        first: any value; dataclasses and tuples are compared field by field.
        second: any value.
        tolerance: tolerance between tensors; if above 0, their dtypes may differ.
    """
    is_same = partial(same, tolerance=tolerance)
    if is_dataclass(first) and type(first) is type(second):
        names = [field.name for field in fields(first)]
        return all(
            is_same(getattr(first, name), getattr(second, name)) for name in names
        )
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(is_same, first, second))
    if not isinstance(first, Tensor) or not isinstance(second, Tensor):
        return type(first) is type(second) and bool(first == second)
    if first.shape != second.shape:
        return False
    if tolerance == 0 and first.dtype != second.dtype:
        return False
    a = first.double()
    b = second.double()
    return torch.allclose(a, b, tolerance, tolerance, equal_nan=True)


def _text_of(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, BenchnavError):
        return text
    return f"{type(error).__name__}: {text}"


def _origin_of(error: Exception) -> str:
    """Return file and line of the innermost frame that is not in an installed package.

    If all frames are in installed packages, it is the innermost frame.
    """
    frames = traceback.extract_tb(error.__traceback__)
    local = [frame for frame in frames if "site-packages" not in frame.filename]
    frame = (local or frames)[-1]
    return f"({Path(frame.filename).name}, line {frame.lineno})"


def _last(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value[-1:]
    return value.select(torch.tensor([-1]))


def _leaves(
    value: Any, name: str = "", visited: set[int] | None = None
) -> Iterator[tuple[str, Any]]:
    """Yield path and copy of each tensor, array, generator, number and text in a value.

    Args:
        value: any value.
        name: path of the value.
        visited: ids of the objects visited so far.
    """
    visited = set() if visited is None else visited
    if isinstance(value, bool | int | float | str | None):
        yield name, repr(value)
        return
    if id(value) in visited or isinstance(value, type):
        return
    visited.add(id(value))
    if isinstance(value, Tensor):
        yield name, value.detach().clone()
    elif isinstance(value, torch.Generator):
        yield name, value.get_state()
    elif isinstance(value, np.ndarray | np.random.Generator):
        yield name, pickle.dumps(value)
    else:
        parts: Mapping[Any, Any] = getattr(value, "__dict__", {})
        if isinstance(value, Mapping):
            parts = value
        elif isinstance(value, list | tuple):
            parts = dict(enumerate(value))
        for key, part in list(parts.items()):
            path = f"{name}.{key}".lstrip(".")
            yield from _leaves(part, path, visited)


def _generators() -> dict[str, bytes]:
    """Return the states of the global generators as bytes, for comparison by `==`."""
    states = {
        "Python's": pickle.dumps(random.getstate()),
        "NumPy's": pickle.dumps(np.random.get_state()),  # noqa: NPY002
        "PyTorch's": bytes(torch.random.get_rng_state().numpy()),
    }
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        states["CUDA's"] = bytes(torch.cuda.get_rng_state().numpy())
    return states
