"""What all checks share: watching calls, comparing answers, and telling every breach of
a contract at once.
"""

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
NOTHING = object()  # what a call that raised has answered


class Breaches:
    """Collects what breaks a contract: each breach once, with the places where it was
    found.

    Args:
        kind: of the part, as in `check_<kind>`.
        name: of the part, for people.
    """

    def __init__(self, kind: str, name: str) -> None:
        """Begins without a breach, and at no place."""
        self._kind, self._name, self.place = kind, name, ""
        self._found: dict[str, list[str]] = {}
        self._places: dict[str, None] = {}

    def expect(self, kept: bool, breach: str) -> bool:
        """Notes a breach at `place`, unless that part of the contract was kept; gives
        whether it was.
        """
        self._places[self.place] = None
        if not kept:
            places = self._found.setdefault(breach, [])
            if self.place and self.place not in places:
                places.append(self.place)
        return kept

    def is_tensor(
        self, what: str, like: Tensor, shape: tuple[int, ...]
    ) -> Callable[[Any], bool]:
        """Gives what expects finite numbers of a shape, in the dtype and on the device
        of another tensor.
        """

        def fits(values: Any) -> bool:
            fault = find_tensor_fault(what, values, like.dtype, shape, like.device)
            is_finite = f"Expected finite {what}, got others."
            return self.expect(not fault, fault) and self.expect(
                bool(values.isfinite().all()), is_finite
            )

        return fits

    def batches(self, device: torch.device | str) -> Iterator["Draws"]:
        """Goes through the dtypes and leading dimensions to be tried, each of which is
        a place.
        """
        for dtype in (torch.float32, torch.float64):
            for leading in ((6,), (6, 5), (6, 5, 2)):
                self.place = f"*B = {list(leading)}, {dtype}"
                like = torch.zeros(1, dtype=dtype, device=device)
                yield Draws(leading, like, torch.Generator().manual_seed(SEED))

    def try_function(
        self,
        what: str,
        act: Callable[..., Any],
        given: Mapping[str, Any],
        is_of_use: Callable[[Any], bool],
        tolerance: float = 1e-5,
    ) -> Any:
        """Tries a pure function of a batch: twice, and for the last of the batch alone.

        Args:
            what: its name, for people.
            act: the function.
            given: its arguments by name: tensors, the batch first, or values that
                `select` takes members from.
            is_of_use: whether there is a point in trying on, given the answer.
            tolerance: by how much answers alone and in a batch may differ.

        Returns:
            The answer; `NOTHING` where it is of no use.
        """
        answer = self.watch(what, lambda: act(**given), **given)
        if answer is NOTHING or not is_of_use(answer):
            return NOTHING
        self.expect(
            same(act(**given), answer),
            f"Expected the same from `{what}` when asked again, got another.",
        )
        alone = self.watch(
            what, lambda: act(**{name: _last(value) for name, value in given.items()})
        )
        self.expect(
            same(alone, _last(answer), tolerance),
            f"Expected the same from `{what}` for one alone and in a batch, got "
            "another.",
        )
        return answer

    def watch(self, what: str, act: Callable[[], Any], **given: Any) -> Any:
        """Calls, and notes what the call did that it should not.

        Args:
            what: its name, for people.
            act: the call.
            given: its arguments by name; tensors, arrays, generators and numbers in
                them are compared before and after, however deep they lie.

        Returns:
            The answer; `NOTHING` where it raised.
        """
        before, states, answer = dict(_leaves(given)), _generators(), NOTHING
        try:
            answer = act()
        except Exception as error:
            text = " ".join(str(error).split())
            named = (
                text
                if isinstance(error, BenchnavError)
                else f"{type(error).__name__}: {text}"
            )
            frames = traceback.extract_tb(error.__traceback__)
            frame = [own for own in frames if "site-packages" not in own.filename][
                -1:
            ] or frames[-1:]
            where = f"({Path(frame[0].filename).name}, line {frame[0].lineno})"
            self.expect(False, f"Expected an answer from `{what}`, got {named} {where}")
        after = dict(_leaves(given))
        changed = [
            name for name, leaf in before.items() if not same(leaf, after.get(name))
        ]
        listed = ", ".join(changed[:3])
        self.expect(
            not changed,
            f"Expected `{what}` to leave its arguments as they were, got another "
            f"{listed}.",
        )
        for whose, state in _generators().items():
            self.expect(
                states.get(whose, state) == state,
                f"Expected {whose} global generator to be left alone, got it changed. "
                "Draw from one of your "
                "own, or from the one that is given.",
            )
        return answer

    def refuse(self) -> None:
        """Raises one error that names every breach; does nothing where there is none.

        Raises:
            ConfigError: there are breaches.
        """
        if not self._found:
            return
        tried = sum(bool(place) for place in self._places)
        listed = ""
        for number, (breach, at) in enumerate(self._found.items(), start=1):
            where = "wherever it was tried" if 1 < len(at) == tried else ", ".join(at)
            listed += f"\n({number}) {breach}{f' [{where}]' if where else ''}"
        raise ConfigError(
            f"Expected a {self._kind} that keeps the contract of "
            f"`benchnav.testing.check_{self._kind}`, got "
            f"{self._name}, which breaks it:{listed}"
        )


@dataclass(frozen=True)
class Draws:
    """Draws arguments of functions of a batch.

    Args:
        leading: their leading dimensions *B.
        like: gives their dtype and device.
        generator: source of randomness.
    """

    leading: tuple[int, ...]
    like: Tensor
    generator: torch.Generator

    def uniform(self, low: Sequence[float], high: Sequence[float]) -> Tensor:
        """Uniform numbers between bounds of length N, shape [*B, N]."""
        least, most = self.like.new_tensor(low), self.like.new_tensor(high)
        share = torch.rand(*self.leading, len(least), generator=self.generator).to(
            self.like
        )
        return least + (most - least) * share


def same(first: Any, second: Any, tolerance: float = 0.0) -> bool:
    """Tells whether two values are the same, tensors by what they hold: NaN equals NaN.

    Args:
        first: anything; dataclasses field by field.
        second: anything.
        tolerance: by how much tensors, then of any dtype, may differ.
    """
    if is_dataclass(first) and type(first) is type(second):
        return all(
            same(getattr(first, f.name), getattr(second, f.name), tolerance)
            for f in fields(first)
        )
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(
            map(partial(same, tolerance=tolerance), first, second)
        )
    if not isinstance(first, Tensor) or not isinstance(second, Tensor):
        return type(first) is type(second) and bool(first == second)
    if first.shape != second.shape or not (tolerance or first.dtype == second.dtype):
        return False
    return torch.allclose(
        first.double(), second.double(), tolerance, tolerance, equal_nan=True
    )


def _last(value: Any) -> Any:
    return value[-1:] if isinstance(value, Tensor) else value.select(torch.tensor([-1]))


def _leaves(
    value: Any, name: str = "", seen: set[int] | None = None
) -> Iterator[tuple[str, Any]]:
    """Lists copies of all tensors, arrays, generators and numbers within a value, by
    where they are.
    """
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
            yield from _leaves(part, f"{name}.{key}".lstrip("."), seen)


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
