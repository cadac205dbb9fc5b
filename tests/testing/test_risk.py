from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav import ConfigError, TraversabilityDistribution, TraversabilityMixture
from benchnav.core import registry
from benchnav.planning import risk
from benchnav.testing import check_risk
from tests.testing.refusal import refusal


def changed(
    change: Callable[[Tensor, TraversabilityMixture], Any],
) -> Callable[[TraversabilityMixture], Any]:
    """The mean, but for what comes of it."""
    return lambda mixture: change(risk.Mean()(mixture), mixture)


class Forgetful:
    """Gives another λ̂ each time."""

    asked = 0

    def __call__(self, mixture: TraversabilityMixture) -> Tensor:
        self.asked += 1
        return risk.Mean()(mixture) / (1 + 0.01 * self.asked)


BAD: dict[str, tuple[Any, str]] = {
    "no function": (3, "got TypeError"),
    "raises": (changed(lambda mean, _: mean[99]), "Expected a result from `risk`, got IndexError"),
    "a number for all": (changed(lambda mean, _: mean.mean()), "a tensor of shape [3, 8, 11], got []"),
    "a map for each component": (changed(lambda mean, m: m.means), "a tensor of shape [3, 8, 11], got [3, 1, 8, 11]"),
    "no tensor": (changed(lambda mean, _: mean.tolist()), "got list"),
    "integers": (changed(lambda mean, _: mean.round().long()), "floating-point tensor, got dtype torch.int64"),
    "above 1": (changed(lambda mean, _: mean + 1), "values in [0, 1]"),
    "below 0": (changed(lambda mean, _: -mean - 0.1), "values in [0, 1]"),
    "no number": (changed(lambda mean, _: mean * torch.nan), "values in [0, 1]"),
    "slip": (changed(lambda mean, m: (m.stds[:, 0] > 0) / mean.new_zeros(())), "values in [0, 1]"),
    "λ̂ of the batch": (changed(lambda mean, _: mean / (1 + mean.mean())), "same result from `risk` for a single"),
    "λ̂ of the neighbours": (changed(lambda mean, _: (mean + mean.roll(1, -1)) / 2), "λ̂ of selected cells to equal"),
    "cannot take some cells": (
        changed(lambda mean, _: mean if mean.shape[-2] > 1 else mean[99]),
        "Expected a result from `risk`, got IndexError",
    ),
    "another λ̂": (Forgetful(), "Expected the same result from `risk` when called again"),
    "writes into the mixture": (changed(lambda mean, m: [m.means.zero_()] and mean), "got changes in distribution"),
    "PyTorch's generator": (changed(lambda mean, _: mean + 0 * torch.rand(1)), "PyTorch's global generator"),
    "NumPy's generator": (changed(lambda mean, _: mean + 0 * np.random.rand()), "NumPy's global"),  # noqa: NPY002
    "knows one component alone": (changed(lambda mean, m: mean + 2 * (m.means.shape[1] - 1)), "[K = 3]"),
}  # fmt: skip


@pytest.mark.parametrize(("measure", "expected"), BAD.values(), ids=BAD.keys())
def test_a_breach_is_caught_and_named(measure: Any, expected: str) -> None:
    assert expected in refusal(check_risk, measure)


def test_what_needs_a_mixture_says_so_by_name_or_fails_on_quantiles() -> None:
    needs = changed(lambda mean, given: mean * given.weights.sum(1))
    said = refusal(check_risk, needs)
    assert (
        "got AttributeError: 'QuantileDistribution' object has no attribute 'weights' (test_risk.py"
        in said
    )
    assert said.endswith(" [quantiles]")

    def refusing(given: TraversabilityDistribution) -> Tensor:
        if not isinstance(given, TraversabilityMixture):
            raise ConfigError(
                f"Expected a TraversabilityMixture, got a {type(given).__name__}."
            )
        return needs(given)

    check_risk(refusing)

    def nameless(given: TraversabilityDistribution) -> Tensor:
        if isinstance(given, TraversabilityMixture):
            return risk.Mean()(given)
        raise ConfigError("Expected something else.")

    raised = nameless.__code__.co_firstlineno + 3
    assert (
        f"Expected something else. (test_risk.py, line {raised}) [quantiles]"
        in refusal(check_risk, nameless)
    )


@pytest.mark.parametrize("name", registry.names("risk"))
def test_every_registered_measure_keeps_the_contract(name: str) -> None:
    check_risk(name)


@pytest.mark.parametrize(
    "measure",
    [
        risk.Mean(),
        risk.CVaR(0.5),
        {"part": "var", "options": {"level": 0.1}},
        "cvar:0.99",
    ],
)
def test_a_measure_is_taken_as_a_function_by_name_or_by_mapping(measure: Any) -> None:
    check_risk(measure)
