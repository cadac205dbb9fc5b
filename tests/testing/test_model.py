import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import pool
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.core.terrain import Observation
from benchnav.models.base import TraversabilityModel, is_family
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.config import MDNConfig
from benchnav.models.nets.mdn import MixtureDensityModel
from benchnav.models.parts import member_name
from benchnav.models.predictor import load_model, open_checkpoint
from benchnav.testing import check_model
from tests.models.support import scale
from tests.models.zoo.support import ZOO
from tests.testing.refusal import refusal

NAMES = ("soft", "firm")


class Good(TraversabilityModel):
    """Two components whose parameters hang on what the cell shows."""

    class_names = NAMES

    def predict(self, observation: Observation) -> TraversabilityMixture:
        share = observation.rgb.float().mean(1) / 255
        weights = torch.stack([share, 1 - share], 1)
        means = torch.stack([share, 1 - observation.slope_deg.float() / 90], 1)
        return TraversabilityMixture(weights, means, torch.full_like(means, 0.1))

    def member_probabilities(self, observation: Observation) -> Tensor:
        return torch.stack([self.predict(observation).weights] * 3)


def changed(
    change: Callable[[TraversabilityMixture, Observation], TraversabilityMixture],
) -> Good:
    """A model that is good but for one thing."""

    class Bad(Good):
        def predict(self, observation: Observation) -> TraversabilityMixture:
            return change(super().predict(observation), observation)

        def member_probabilities(self, observation: Observation) -> Tensor:
            return torch.stack([Good.predict(self, observation).weights])

    return Bad()


def with_members(members: Callable[[Tensor], object]) -> Good:
    class Bad(Good):
        def member_probabilities(self, observation: Observation) -> Tensor:
            return members(self.predict(observation).weights)  # type: ignore[return-value]

    return Bad()


def with_soft_spots(owner: int) -> Good:
    """The second class is split into a firm and a soft component, of which the latter
    is told to be another's.
    """

    class Split(Good):
        def predict(self, observation: Observation) -> TraversabilityMixture:
            whole = super().predict(observation)
            first, second = whole.weights.unbind(1)
            weights = torch.stack([first, 0.1 * second, 0.9 * second], 1)
            means, stds = whole.means[:, [0, 1, 1]], whole.stds[:, [0, 1, 1]]
            return TraversabilityMixture(weights, means, stds, (0, 1, owner))

        def member_probabilities(self, observation: Observation) -> Tensor:
            return Good.predict(self, observation).weights[None]

    return Split()


def meddling(act: Callable[[Observation], object]) -> Good:
    def change(
        mixture: TraversabilityMixture, observation: Observation
    ) -> TraversabilityMixture:
        act(observation)
        return mixture

    return changed(change)


def poked(name: str, value: float) -> Good:
    """One number alone is wrong, in the last cell."""

    def change(
        mixture: TraversabilityMixture, observation: Observation
    ) -> TraversabilityMixture:
        values = getattr(mixture, name).clone()
        values[-1, -1, -1, -1] = value
        return replace(mixture, **{name: values})

    return changed(change)


class Forgetful(Good):
    """Gives another answer each time it is asked."""

    asked = 0

    def predict(self, observation: Observation) -> TraversabilityMixture:
        self.asked += 1
        found = super().predict(observation)
        return replace(found, means=found.means + 1e-6 * self.asked)


class Needy(Good):
    """Takes square maps alone."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        if observation.grid.height != observation.grid.width:
            raise ValueError("sides differ")
        return super().predict(observation)


class Nameless(Good):
    class_names = ()


class Misnamed(Good):
    class_names = (*NAMES, "third")


def crop(mixture: TraversabilityMixture, _: Observation) -> TraversabilityMixture:
    return TraversabilityMixture(
        mixture.weights[..., :-1, :],
        mixture.means[..., :-1, :],
        mixture.stds[..., :-1, :],
    )


def transpose(mixture: TraversabilityMixture, _: Observation) -> TraversabilityMixture:
    return TraversabilityMixture(mixture.weights.mT, mixture.means.mT, mixture.stds.mT)


def whole(mixture: TraversabilityMixture, _: Observation) -> TraversabilityMixture:
    weights = torch.zeros_like(mixture.weights)
    weights[:, 0] = 1
    return TraversabilityMixture(
        weights.long(), mixture.means.long(), mixture.stds.long()
    )


def of_batch(mixture: TraversabilityMixture, _: Observation) -> TraversabilityMixture:
    return replace(mixture, means=mixture.means - mixture.means.mean())


def elsewhere(mixture: TraversabilityMixture, _: Observation) -> TraversabilityMixture:
    return TraversabilityMixture(
        mixture.weights.to("meta"), mixture.means, mixture.stds
    )


BAD = {
    "no predict": (object(), "Expected the model to be an instance of benchnav.models.TraversabilityModel, got object"),
    "an error": (Needy(), "ValueError: sides differ (test_model.py, line 128) [20×37]"),
    "no mixture": (
        changed(lambda mixture, _: mixture.weights),
        "TraversabilityDistribution of shape [3, 32, 32], got Tensor",
    ),
    "one map for all": (
        changed(lambda m, _: TraversabilityMixture(m.weights[:1], m.means[:1], m.stds[:1])),
        "[3, 32, 32], got TraversabilityMixture of shape [1, 32, 32]",
    ),
    "a row short": (changed(crop), "[3, 32, 32], got TraversabilityMixture of shape [3, 31, 32]"),
    "height for width": (changed(transpose), "[3, 20, 37], got TraversabilityMixture of shape [3, 37, 20]"),
    "integers": (changed(whole), "one floating-point dtype, got torch.int64"),
    "two dtypes": (changed(lambda m, _: replace(m, means=m.means.double())), "got torch.float32, torch.float64"),
    "elsewhere": (changed(elsewhere), "parameters on the observation's device cpu, got meta"),
    "a weight that is no number": (poked("weights", float("nan")), "finite `weights`"),
    "an infinite mean": (poked("means", float("inf")), "finite `means`"),
    "an infinite std": (poked("stds", float("inf")), "finite `stds`"),
    "a negative std": (poked("stds", -0.1), "`stds` ≥ 0"),
    "a negative weight": (
        changed(lambda m, _: replace(m, weights=3 * m.weights - 1)),
        "`weights` ≥ 0",
    ),
    "weights of another sum": (poked("weights", 0.0), "sum to 1"),
    "an observation brightened": (meddling(lambda seen: seen.rgb.add_(1)), "got changes in observation.rgb"),
    "an observation flattened": (meddling(lambda seen: seen.slope_deg.zero_()), "got changes in observation.slope_deg"),
    "PyTorch's generator": (meddling(lambda _: torch.rand(1)), "PyTorch's global generator"),
    "PyTorch's seed": (meddling(lambda _: torch.manual_seed(54321)), "PyTorch's global generator"),
    "NumPy's generator": (meddling(lambda _: np.random.rand()), "NumPy's global generator"),  # noqa: NPY002
    "Python's generator": (meddling(lambda _: random.random()), "Python's global generator"),
    "another answer": (Forgetful(), "Expected the same result from `predict` when called again"),
    "an answer of the batch": (changed(of_batch), "Expected the same result from `predict` for a single element"),
    "too many names": (Misnamed(), "each of 2 components, got 3"),
    "members without names": (Nameless(), "Expected `class_names` with"),
    "members of another shape": (with_members(lambda weights: weights), "shape [M, 3, 2, 32, 32], got [3, 2, 32, 32]"),
    "too few maps of members": (with_members(lambda weights: weights[None, :1]), "got [1, 1, 2, 32, 32]"),
    "no members": (with_members(lambda weights: weights[None][:0]), "got [0, 3, 2, 32, 32]"),
    "members that are no tensor": (with_members(lambda weights: [weights]), "got list"),
    "members of another average": (
        with_members(lambda weights: weights.flip(1)[None]),
        "as the average of `member_probabilities` does",
    ),
    "components of a class without a name": (
        changed(lambda mixture, _: replace(mixture, group=(0, 2))),
        "classes in `group` below 2, which is the number of `class_names`, got 2",
    ),
    "members whose soft spots are summed up wrongly": (with_soft_spots(0), "as the average of"),
    "members that raise": (with_members(lambda weights: weights[9]), "IndexError"),
    "members that draw": (
        with_members(lambda weights: weights[None] + 0 * torch.rand(1)),
        "PyTorch's global generator",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("model", "expected"), BAD.values(), ids=BAD.keys())
def test_a_breach_is_caught_and_named(model: object, expected: str) -> None:
    assert expected in refusal(check_model, model)


def test_every_breach_is_named_once_with_the_maps_it_was_found_on() -> None:
    model = poked("stds", -0.1)
    model.class_names = (*NAMES, "third")  # type: ignore[assignment]
    with pytest.raises(ConfigError) as caught:
        check_model(model, shapes=((9, 9), (12, 7)))
    message = str(caught.value)
    assert message.count("`stds` ≥ 0") == message.count("each of 2 components") == 1
    assert message.count("[in all cases]") == 2


def test_components_of_one_class_are_summed_up() -> None:
    check_model(with_soft_spots(1))


def test_a_pool_may_be_calibrated_as_a_whole() -> None:
    class Sharper(Good):
        def member_probabilities(self, observation: Observation) -> Tensor:
            return self.predict(observation).weights.sqrt().div(2)[None]

    check_model(Sharper())


def test_a_model_that_takes_one_size_alone_names_it() -> None:
    check_model(Needy(), shapes=((24, 24),))


def test_the_tolerance_is_of_sums_and_of_maps_alone() -> None:
    model = changed(lambda m, _: replace(m, weights=m.weights * 1.001))
    check_model(model, tolerance=0.01)
    with pytest.raises(ConfigError, match="sum to 1"):
        check_model(model)


def test_a_good_model_keeps_the_contract_and_is_tried_on_maps_of_many_colours_and_slopes() -> (
    None
):
    seen: list[Observation] = []
    check_model(meddling(seen.append))
    assert sorted({(len(one.rgb), *one.grid.shape) for one in seen}) == [
        (1, 20, 37),
        (1, 32, 32),
        (3, 20, 37),
        (3, 32, 32),
    ]
    for one in seen:
        assert len(one.rgb.movedim(1, -1).flatten(0, 2).unique(dim=0)) > 50
        assert float(one.slope_deg.std()) > 1
    first, second = seen[0].rgb[:2]
    assert not torch.equal(first, second)


def family(name: str) -> bool:
    return is_family(registry.find("model", name).target)


@pytest.mark.parametrize(
    "name", [name for name in registry.names("model") if not family(name)]
)
def test_every_registered_model_keeps_the_contract(name: str) -> None:
    check_model(load_model(name))
    check_model(name, shapes=((9, 9),))


def test_the_families_whose_checkpoints_are_tried_here_are_all_that_the_package_has() -> (
    None
):
    own = {
        name for name in registry.names("model") if registry.find("model", name).shipped
    }
    assert {name for name in own if family(name)} == {"fused", "mdn", *ZOO}


@pytest.mark.parametrize("name", ZOO)
def test_models_of_the_zoo_are_found_by_name(name: str) -> None:
    # which tests/models/zoo/test_zoo.py tries
    assert registry.find("model", name).target is ZOO[name][0]


@pytest.mark.parametrize("members", [1, 2])
def test_fused_models_keep_the_contract(checkpoint_path: Path, members: int) -> None:
    checkpoint = load_checkpoint(checkpoint_path)
    for index in range(1, members):
        part = checkpoint.part("classifier")
        generator = torch.Generator().manual_seed(index)
        tensors = {
            name: value * torch.rand(value.shape, generator=generator)
            if value.ndim > 3
            else value
            for name, value in part.tensors.items()
        }
        checkpoint = checkpoint.with_part(
            member_name(index, "classifier"), replace(part, tensors=tensors)
        )
    check_model(open_checkpoint(checkpoint))


def test_a_mixture_density_model_keeps_the_contract() -> None:
    scales = scale(torch.full((3,), 90.0), torch.full((3,), 40.0), 9.0)
    check_model(
        MixtureDensityModel(MDNConfig(encoder="mobilenet_v2")).build(scales).eval()
    )


class Quantiles(TraversabilityModel):
    """Quantiles from half of what the cell shows up to all of it, with an atom, and one
    thing changed.
    """

    def __init__(
        self,
        change: Callable[
            [QuantileDistribution], TraversabilityDistribution
        ] = lambda found: found,
    ) -> None:
        self.change = change

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        share = observation.rgb.float().mean(1, keepdim=True) / 255
        levels = torch.tensor(LEVELS, device=share.device).view(-1, 1, 1)
        levels = torch.where((levels > 0.4) & (levels < 0.6), 0.4, levels)
        return self.change(QuantileDistribution(0.5 * share * (1 + levels)))


def test_a_model_of_quantiles_and_a_pool_of_models_keep_the_contract() -> None:
    check_model(Quantiles())
    check_model(
        Quantiles(
            lambda found: pool([found, replace(found, values=found.values.square())])
        )
    )


def overriding(
    **methods: Callable[..., object],
) -> Callable[[QuantileDistribution], TraversabilityDistribution]:
    kind = type("Own", (QuantileDistribution,), methods)
    return lambda found: kind(found.values)


class Named(Quantiles):
    class_names = NAMES


BAD_DISTRIBUTIONS = {
    "of descending quantiles": (lambda d: replace(d, values=d.values.flip(1)), "`quantile` to ascend"),
    "beyond 1": (lambda d: replace(d, values=d.values + 1), "`cdf` to ascend from 0 below λ = 0 to 1 at λ = 1"),
    "under 0": (lambda d: replace(d, values=d.values - 0.3), "`quantile` to ascend with the probability"),
    "with a hole": (
        lambda d: replace(d, values=d.values.where(d.values < d.values.max(), torch.nan)),
        "finite results of `quantile` of the distribution",
    ),
    "elsewhere": (lambda d: d.to("meta"), "observation's device cpu, got meta"),
    "a row short": (lambda d: replace(d, values=d.values[..., 1:, :]), "got QuantileDistribution of shape [3, 31, 32]"),
    "of another inverse": (
        overriding(quantile=lambda d, u: 0.9 * QuantileDistribution.quantile(d, u)), "inverse of `cdf`",
    ),
    "of another mean": (overriding(mean=lambda d: QuantileDistribution.mean(d) + 0.01), "`mean` to agree with"),
    "of another tail": (overriding(cvar=lambda d, level: d.var(level)), "`cvar` to agree with"),
    "of another time": (overriding(expected_time=lambda d, floor: 1 / d.mean()), "`expected_time` to agree with"),
    "of other limits": (overriding(cdf_limits=lambda d, x: (0 * d.cdf(x), d.cdf(x)), cdf=lambda d, x: (
        QuantileDistribution.cdf_limits(d, x)[1])), "`cdf_limits` to return P(λ < value)"),
    "of another dtype": (
        overriding(quantile=lambda d, u: QuantileDistribution.quantile(d, u).double()), "torch.float32",
    ),
    "that raises": (overriding(cdf=lambda d, x: 1 / 0), "ZeroDivisionError"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "expected"), BAD_DISTRIBUTIONS.values(), ids=BAD_DISTRIBUTIONS.keys()
)
def test_a_distribution_that_is_none_is_named(
    change: Callable[[QuantileDistribution], TraversabilityDistribution], expected: str
) -> None:
    assert expected in refusal(check_model, Quantiles(change))


def test_names_of_classes_without_their_probabilities_are_refused() -> None:
    assert "got a QuantileDistribution without classes" in refusal(check_model, Named())
