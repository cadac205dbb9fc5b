"""Tools of all checks: calls with checks of side effects, comparisons, breaches."""

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
NOTHING = object()  # replaces the answer of a call that raised


class Breaches:
    """Collection of the breaches of a contract, each listed once with its locations.

    Args:
        kind: kind of the part, as in `check_<kind>`.
        name: name of the part in messages.

    Attributes:
        location: location of the next breaches, such as a size of maps.
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
        self, what: str, like: Tensor, shape: tuple[int, ...]
    ) -> Callable[[Any], bool]:
        """Return a function that expects finite numbers of a shape.

        Args:
            what: description of the values, for messages.
            like: tensor of the expected dtype and device.
            shape: expected shape.
        """

        def fits(values: Any) -> bool:
            fault = find_tensor_fault(what, values, like.dtype, shape, like.device)
            if not self.expect(not fault, fault):
                return False
            is_finite = bool(values.isfinite().all())
            return self.expect(is_finite, f"Expected finite {what}, got others.")

        return fits

    def batches(self, device: torch.device | str) -> Iterator["Draws"]:
        """Yield each dtype and leading shape to check, after setting `location`."""
        for dtype in (torch.float32, torch.float64):
            for leading in ((6,), (6, 5), (6, 5, 2)):
                self.location = f"*B = {list(leading)}, {dtype}"
                like = torch.zeros(1, dtype=dtype, device=device)
                generator = torch.Generator().manual_seed(SEED)
                yield Draws(leading, like, generator)

    def try_function(
        self,
        what: str,
        act: Callable[..., Any],
        arguments: Mapping[str, Any],
        is_usable: Callable[[Any], bool],
        tolerance: float = 1e-5,
    ) -> Any:
        """Call a pure function of a batch twice, and for its last element only.

        Args:
            what: name of the function in messages.
            act: the function.
            arguments: arguments of the function by name: tensors whose first dimension
                is the batch, or values with a method `select`.
            is_usable: function that returns whether an answer can be checked further.
            tolerance: tolerance between answers for a single element and a batch.

        Returns:
            The answer; `NOTHING` if it is not usable.
        """
        answer = self.watch(what, lambda: act(**arguments), **arguments)
        if answer is NOTHING or not is_usable(answer):
            return NOTHING
        again = act(**arguments)
        self.expect(
            same(again, answer),
            f"Expected the same result from `{what}` when called again, got another.",
        )
        last_only = {name: _last(value) for name, value in arguments.items()}
        single = self.watch(what, lambda: act(**last_only))
        expected = _last(answer)
        self.expect(
            same(single, expected, tolerance),
            f"Expected the same result from `{what}` for a single element as in a batch, "
            "got another.",
        )
        return answer

    def watch(self, what: str, act: Callable[[], Any], **arguments: Any) -> Any:
        """Call a function, and note an exception or a side effect.

        Args:
            what: name of the function in messages.
            act: the call.
            arguments: arguments of the call by name; all tensors, arrays, generators
                and numbers nested in them are compared before and after the call.

        Returns:
            The answer; `NOTHING` if the call raised.
        """
        before = dict(_leaves(arguments))
        states = _generators()
        answer = NOTHING
        try:
            answer = act()
        except Exception as error:
            got = f"{_text_of(error)} {_origin_of(error)}"
            self.expect(False, f"Expected an answer from `{what}`, got {got}")
        after = dict(_leaves(arguments))
        changed = []
        for name, leaf in before.items():
            if not same(leaf, after.get(name)):
                changed.append(name)
        listed = ", ".join(changed[:3])
        self.expect(
            not changed,
            f"Expected `{what}` to leave its arguments unchanged, got another "
            f"{listed}.",
        )
        for whose, state in _generators().items():
            previous = states.get(whose, state)
            self.expect(
                previous == state,
                f"Expected {whose} global generator to be unchanged, got a change. "
                "Draw from a generator of your own, or from the one that is passed.",
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
            where = ", ".join(locations)
            if 1 < len(locations) == n_locations:
                where = "wherever it was tried"
            listed += f"\n({number}) {breach}"
            if where:
                listed += f" [{where}]"
        raise ConfigError(
            f"Expected a {self._kind} that fulfils the contract of "
            f"`benchnav.testing.check_{self._kind}`, got "
            f"{self._name}, which breaks it:{listed}"
        )


@dataclass(frozen=True)
class Draws:
    """A source of random arguments for functions of a batch.

    Args:
        leading: leading dimensions *B.
        like: tensor of the dtype and device.
        generator: source of randomness.
    """

    leading: tuple[int, ...]
    like: Tensor
    generator: torch.Generator

    def uniform(self, low: Sequence[float], high: Sequence[float]) -> Tensor:
        """Draw uniform numbers between bounds of length N, shape [*B, N]."""
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
    """Return file and line of the innermost frame outside installed packages."""
    frames = traceback.extract_tb(error.__traceback__)
    local = [frame for frame in frames if "site-packages" not in frame.filename]
    frame = (local or frames)[-1]
    return f"({Path(frame.filename).name}, line {frame.lineno})"


def _last(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value[-1:]
    return value.select(torch.tensor([-1]))


def _leaves(
    value: Any, name: str = "", seen: set[int] | None = None
) -> Iterator[tuple[str, Any]]:
    """Yield path and copy of each tensor, array, generator and number in a value."""
    seen = set() if seen is None else seen
    if isinstance(value, bool | int | float | str | None):
        yield name, repr(value)
        return
    if id(value) in seen or isinstance(value, type):
        return
    seen.add(id(value))
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
            yield from _leaves(part, path, seen)


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
