import random
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.batch import Batch
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.sensing.belief import (
    Belief,
    CovarianceModel,
    Static,
    draw_scores,
    fields_of,
)
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.sensor import Measurement
from benchnav.testing import check_belief
from benchnav.testing.belief_inputs import create_predictions
from tests.testing.refusal import refusal

SMALL, FEW = ((6, 8),), 50


@dataclass(frozen=True)
class Known(Batch):
    """What was observed of each cell for itself; it can be written into."""

    prior: TraversabilityDistribution
    covariance: CovarianceModel
    score: Tensor
    std: Tensor


class Good(Belief[Known]):
    """Learns of each cell that was sensed, and nothing of others; takes mixtures alone."""

    def init(
        self, prior: TraversabilityDistribution, covariance: CovarianceModel
    ) -> Known:
        if not isinstance(prior, TraversabilityMixture):
            raise ConfigError(f"Expected a mixture, got {type(prior).__name__}.")
        nothing = torch.zeros(prior.shape, dtype=prior.dtype)
        return Known(prior, covariance, nothing, nothing + 1)

    def update(
        self,
        state: Known,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> Known:
        if prior is not None:
            state = replace(state, prior=prior)
        value = sensed.traversability.nan_to_num()
        low, high = (end.clamp(-3, 3) for end in state.prior.to_normal(value))
        return replace(
            state,
            score=torch.where(sensed.mask, (low + high) / 2, state.score),
            std=torch.where(sensed.mask, sensed.std, state.std),
        )

    def distribution(self, state: Known) -> TraversabilityDistribution:
        return ConditionedDistribution(state.prior, state.score, state.std)

    def changed(self, before: Known, after: Known) -> Tensor:
        other = before.prior.differs(after.prior)
        return other | (before.score != after.score) | (before.std != after.std)

    def sample_fields(self, state: Known, count: int, keys: Sequence[int]) -> Tensor:
        drawn = draw_scores(
            replace(state.covariance, correlation_m=0.0), count, keys
        ).to(state.std)
        return fields_of(state.prior, state.score[:, None] + state.std[:, None] * drawn)


def having(**methods: Any) -> Good:
    return type("Bad", (Good,), methods)()


def doing(name: str, act: Callable[..., object]) -> Good:
    """Good, but for what it does before one of its methods."""

    def method(self: Good, *given: Any, **named: Any) -> Any:
        act(*given)
        return getattr(Good, name)(self, *given, **named)

    return having(**{name: method})


def giving(name: str, change: Callable[..., Any]) -> Good:
    """Good, but for what one of its methods gives."""
    return having(
        **{name: lambda self, *given: change(getattr(Good, name)(self, *given), *given)}
    )


class OnSelf(Good):
    """Remembers how often it was told."""

    count = 0

    def update(
        self,
        state: Known,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> Known:
        self.count += 1
        return replace(
            super().update(state, sensed, prior), std=state.std * 0.99**self.count
        )


class LastBegun(Good):
    """Remembers itself the prediction that was begun last."""

    def init(
        self, prior: TraversabilityDistribution, covariance: CovarianceModel
    ) -> Known:
        self.prior = prior
        return super().init(prior, covariance)

    def distribution(self, state: Known) -> TraversabilityDistribution:
        if self.prior.shape == state.prior.shape:
            return ConditionedDistribution(self.prior, state.score, state.std)
        return super().distribution(state)


def blurred(state: Known, *_: Any) -> Known:
    return replace(state, std=state.std * 0.9)


def shared(state: Known, before: Known, sensed: Measurement, *_: Any) -> Known:
    """Learns in all episodes what is sensed in any."""
    return replace(state, score=state.score + sensed.mask.float().mean())


def unkeyed(fields: Tensor, state: Known, count: int, keys: Sequence[int]) -> Tensor:
    return Good().sample_fields(state, count, [7] * len(keys))


def in_turn(fields: Tensor, state: Known, count: int, keys: Sequence[int]) -> Tensor:
    return Good().sample_fields(
        state, count, [key + place for place, key in enumerate(keys)]
    )


def of_the_prior(
    fields: Tensor, state: Known, count: int, keys: Sequence[int]
) -> Tensor:
    return fields_of(state.prior, draw_scores(state.covariance, count, keys))


BAD: dict[str, tuple[Any, str]] = {
    "no belief": (object(), "Expected the belief to be an instance of benchnav.planning.Belief, got object"),
    "learns by a word": (having(learns="yes"), "Expected `learns` of type bool, got 'yes'"),
    "writes into the state": (doing("update", lambda s, *_: s.std.mul_(0.5)), "got changes in state.std."),
    "writes into what is sensed": (doing("update", lambda _, s, *__: s.std.mul_(2)), "got changes in sensed.std."),
    "writes into the prediction": (doing("init", lambda p, _: p.means.mul_(0.5)), "got changes in prior.means."),
    "writes while it is asked": (doing("at", lambda s, _: s.std.mul_(0.5)), "`at` to leave its arguments unchanged"),
    "writes while it draws": (doing("sample_fields", lambda s, *_: s.score.add_(1)), "`sample_fields` to leave its"),
    "PyTorch's generator": (doing("update", lambda *_: torch.rand(1)), "PyTorch's global generator"),
    "NumPy's generator": (doing("sample_fields", lambda *_: np.random.rand()), "NumPy's global generator"),  # noqa: NPY002
    "Python's generator": (doing("init", lambda *_: random.random()), "Python's global generator"),
    "raises": (doing("update", lambda s, *_: s.std[9]), "Expected a result from `update`, got IndexError"),
    "raises when a prediction is new": (
        doing("update", lambda _, __, p=None: None if p is None else p.means[9]), "from `update`, got IndexError"
    ),
    "no distribution": (giving("distribution", lambda *_: 3), "Expected a TraversabilityDistribution"),
    "one map for all": (giving("distribution", lambda d, _: d.select(torch.tensor([0]))), "got one of shape [1, 6, 8]"),
    "no numbers": (giving("init", lambda s, *_: replace(s, std=s.std * torch.nan)), "of the belief in [0, 1]"),
    "another prediction": (giving("init", blurred), "initial belief to equal the prediction, got differences"),
    "forgets over time": (giving("update", blurred), "an update without measurements to change nothing"),
    "what the batch has": (
        giving("update", lambda new, *_: replace(new, std=new.std * (0.99 if len(new.std) == 4 else 0.8))),
        "do not depend on the other episodes of the batch",
    ),
    "evolves on self": (OnSelf(), "Expected the same result from `update` when called again"),
    "what was begun on self": (LastBegun(), "Expected the same belief after `init` on other maps"),
    "tells episodes of each other": (giving("update", shared), "`select` to return episodes with unchanged beliefs"),
    "changed no map": (giving("changed", lambda c, *_: c[0]), "Expected a bool map of shape [4, 6, 8] from `changed`"),
    "changed too little": (giving("changed", lambda c, *_: c & False), "Expected `changed` to mark all cells"),
    "changed by scores alone": (
        giving("changed", lambda _, a, b: (a.score != b.score) | (a.std != b.std)), "Expected `changed` to mark all"
    ),
    "counts again what it knows": (
        giving("update", lambda new, old, s, *_: replace(new, std=torch.where(s.mask, 0.5 * old.std, new.std))),
        "Expected a repeated measurement without noise to change nothing",
    ),
    "less sure by what it learns": (
        giving("update", lambda new, old, s, *_: replace(
            new, std=torch.where(s.mask.flatten(1).any(1)[:, None, None] & ~s.mask, 1.3 * old.std, new.std)
        )),
        "to reduce the variance of λ ≤ value on average",
    ),
    "learns though it says no": (having(learns=False), "a belief that does not learn (`learns`)"),
    "keeps the old prediction": (
        giving("update", lambda new, old, *_: replace(new, prior=old.prior)), "to replace the old one"
    ),
    "at of all": (giving("at", lambda _, s, __: s.prior), "distribution of shape [1, 38], got [4, 6, 8]"),
    "at of the prediction": (giving("at", lambda _, s, cells: s.prior.at(cells)), "Expected mean and CVaR of `at`"),
    "too few fields": (giving("sample_fields", lambda f, *_: f[:, 0]), "Expected fields of shape [4, 50, 6, 8]"),
    "fields of no λ": (giving("sample_fields", lambda f, *_: f + 1), "Expected fields of λ in [0, 1]"),
    "fields without keys": (giving("sample_fields", unkeyed), "Expected different fields from different keys"),
    "fields by place": (giving("sample_fields", in_turn), "fields to depend only on its state and key"),
    "fields of the prediction": (giving("sample_fields", of_the_prior), "the belief's distribution"),
    "selects others": (having(select=lambda _, s, m: s.select(m.sort().values)), "`select` to return episodes"),
    "puts nothing": (having(put=lambda _, s, m, o: s), "`put` to insert"),
    "puts elsewhere": (having(put=lambda b, s, m, o: s.put(m.flip(0), o)), "`put` to insert"),
    "selects nothing": (having(select=lambda _, s, m: s), "shape [2, 6, 8] for episodes that `select` returns"),
}  # fmt: skip


@cache
def _predictions(*key: Any) -> Any:
    return create_predictions(*key)


@pytest.fixture(autouse=True)
def _predict_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute the predictions of each kind once; beliefs get copies to write into."""
    monkeypatch.setattr(
        "benchnav.testing.belief.create_predictions",
        lambda *key: deepcopy(_predictions(*key)),
    )


@pytest.mark.parametrize(("belief", "expected"), BAD.values(), ids=BAD.keys())
def test_contract_violation_is_reported(
    belief: Any, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchnav.testing.belief_fields._FIELDS", FEW)
    assert expected in refusal(lambda one: check_belief(one, SMALL), belief)


def test_a_good_belief_passes_on_predictions_worth_trying() -> None:
    begun: list[tuple[str, tuple[int, ...]]] = []
    told: list[Measurement] = []

    class Spy(Good):
        def init(
            self, prior: TraversabilityDistribution, covariance: CovarianceModel
        ) -> Known:
            begun.append((type(prior).__name__, tuple(prior.shape)))
            return super().init(prior, covariance)

        def update(
            self,
            state: Known,
            sensed: Measurement,
            prior: TraversabilityDistribution | None = None,
        ) -> Known:
            told.append(sensed)
            return super().update(state, sensed, prior)

    check_belief(Spy())
    assert ("QuantileDistribution", (4, 10, 10)) in begun
    assert {shape for kind, shape in begun if kind == "TraversabilityMixture"} == {
        (batch, *shape) for batch in (4, 2, 1) for shape in ((10, 10), (8, 13))
    }
    seen = torch.cat([sensed.traversability[sensed.mask] for sensed in told])
    assert {0.0, 1.0} <= set(seen.tolist())
    assert ((seen > 0) & (seen < 1)).any()
    assert any(not sensed.mask.any() for sensed in told)


def test_a_refusal_of_quantiles_has_to_name_them() -> None:
    def refuse(prior: TraversabilityDistribution, covariance: CovarianceModel) -> None:
        if not isinstance(prior, TraversabilityMixture):
            raise ConfigError("Expected another model.")

    said = refusal(lambda one: check_belief(one, SMALL), doing("init", refuse))
    assert "from `init`, got Expected another model." in said
    assert said.endswith("[6×8, quantiles]")


@pytest.mark.parametrize(
    "belief",
    [
        *registry.names("belief"),
        Static(correlated=False),
        Copula("estimated"),
        Copula(0.0, 4),
    ],
)
def test_every_belief_that_is_shipped_keeps_the_contract(belief: Any) -> None:
    check_belief(belief, SMALL)
