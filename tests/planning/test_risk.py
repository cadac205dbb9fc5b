from dataclasses import replace

import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning import risk
from tests.core.distributions import quantiles
from tests.core.test_mixture import random_mixture


def test_measures_by_name_are_those_of_the_mixture() -> None:
    mixture = random_mixture()
    for text, expected in (
        ("cvar", mixture.cvar(0.9)),
        ("cvar:0.5", mixture.cvar(0.5)),
        ("var", mixture.var(0.9)),
        ("var:0.95", mixture.var(0.95)),
        ("mean", mixture.mean()),
        ("expected-time", (1 / mixture.expected_time(0.05)).clamp(0.05, 1)),
        ("expected-time:0.2", (1 / mixture.expected_time(0.2)).clamp(0.2, 1)),
        ("time-cvar", (1 / mixture.time_cvar(0.9, 0.05)).clamp(0.05, 1)),
        ("time-cvar:0.6", (1 / mixture.time_cvar(0.6, 0.05)).clamp(0.05, 1)),
        (
            {"part": "time-cvar", "options": {"level": 0.6, "floor": 0.2}},
            (1 / mixture.time_cvar(0.6, 0.2)).clamp(0.2, 1),
        ),
        ("chance", mixture.chance(0.1)),
        ("chance:0.4", mixture.chance(0.4)),
        ("single-class", mixture.most_likely().cvar(0.9)),
        ("single-class:0.2", mixture.most_likely().cvar(0.2)),
        ({"part": "cvar", "options": {"level": 0.3}}, mixture.cvar(0.3)),
    ):
        assert torch.equal(
            risk.apply(registry.make("risk", text), mixture), expected
        ), text


@pytest.mark.parametrize("text", ["cvr", "cvar:x", "mean:0.5", ""])
def test_measures_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        registry.make("risk", text)


@pytest.mark.parametrize("level", [1.0, -0.1])
@pytest.mark.parametrize("name", ["cvar", "var", "single-class"])
def test_levels_out_of_range_are_refused(name: str, level: float) -> None:
    with pytest.raises(ConfigError, match="level"):
        risk.apply(registry.make("risk", f"{name}:{level}"), random_mixture())


def test_a_higher_level_is_more_cautious() -> None:
    mixture = random_mixture()
    for measure in (risk.VaR, risk.CVaR, risk.SingleClass):
        low, high = (risk.apply(measure(level), mixture) for level in (0.3, 0.95))
        assert (high <= low + 1e-9).all()
        assert (high < low).any()


def test_a_users_measure_is_applied_and_its_map_takes_the_mixtures_dtype() -> None:
    mixture = random_mixture()
    single = TraversabilityMixture(
        mixture.weights.float(), mixture.means.float(), mixture.stds.float()
    )
    worst = risk.apply(lambda given: given.cvar(0.99).double(), single)
    assert worst.dtype == torch.float32
    assert torch.equal(worst, single.cvar(0.99))


@pytest.mark.parametrize(
    ("measure", "expected"),
    [
        (lambda mixture: mixture, "shape [2, 1, 6], got TraversabilityMixture"),
        (lambda mixture: mixture.means, "shape [2, 1, 6], got [2, 4, 1, 6]"),
        (lambda mixture: mixture.mean()[0], "got [1, 6]"),
        (lambda mixture: mixture.mean().mT, "got [2, 6, 1]"),
        (lambda mixture: None, "got NoneType"),
        (
            lambda mixture: mixture.mean() > 0.3,
            "floating-point tensor, got dtype torch.bool",
        ),
        (lambda mixture: mixture.mean() + 1, "in [0, 1], got values outside"),
        (lambda mixture: mixture.mean() - 1, "in [0, 1], got values outside"),
        (lambda mixture: mixture.mean() * torch.nan, "or NaN"),
    ],
)
def test_what_is_no_map_of_traversability_is_refused(measure, expected: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError) as caught:
        risk.apply(measure, random_mixture())
    assert expected in str(caught.value)


@pytest.mark.parametrize("name", registry.names("risk"))
def test_a_measure_changes_nothing_that_it_is_given(name: str) -> None:
    mixture = random_mixture()
    before = [value.clone() for value in (mixture.weights, mixture.means, mixture.stds)]
    risk.apply(registry.make("risk", name), mixture)
    after = (mixture.weights, mixture.means, mixture.stds)
    assert all(torch.equal(*pair) for pair in zip(before, after, strict=True))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("chance:1.5", "bound"),
        ("expected-time:0", "minimum speed"),
        ("time-cvar:1", "level"),
    ],
)
def test_options_of_other_measures_out_of_range_are_refused(
    text: str, word: str
) -> None:
    with pytest.raises(ConfigError, match=word):
        risk.apply(registry.make("risk", text), random_mixture())


def test_single_class_of_components_that_are_no_classes_is_refused_by_name() -> None:
    mixture = replace(random_mixture(), group=None)
    with pytest.raises(ConfigError, match="single-class"):
        risk.apply(registry.make("risk", "single-class"), mixture)


def test_measures_are_those_of_any_distribution_and_single_class_refuses_by_name() -> (
    None
):
    law = quantiles()
    for text, expected in (
        ("mean", law.mean()), ("cvar:0.7", law.cvar(0.7)), ("var:0.7", law.var(0.7)), ("chance:0.2", law.chance(0.2)),
        ("expected-time:0.1", 1 / law.expected_time(0.1)), ("time-cvar:0.7", 1 / law.time_cvar(0.7, 0.05)),
    ):  # fmt: skip
        assert torch.equal(risk.apply(registry.make("risk", text), law), expected), text
    with pytest.raises(
        ConfigError, match="single-class option, got QuantileDistribution"
    ):
        risk.apply(registry.make("risk", "single-class"), law)
