import pytest
import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.models.probabilities import class_probabilities, sharpen


def mixture(group: tuple[int, ...] | None, components: int = 3) -> TraversabilityMixture:
    weights = torch.rand(2, components, 4, 5, generator=torch.Generator().manual_seed(0))
    weights = weights / weights.sum(1, keepdim=True)
    return TraversabilityMixture(weights, weights, weights, group)


def test_the_components_of_a_class_are_added_up_in_the_order_of_the_classes() -> None:
    made = mixture((2, 0, 2))
    found = class_probabilities(made, 4)
    assert found.shape == (2, 4, 4, 5)
    torch.testing.assert_close(found[:, 2], made.weights[:, 0] + made.weights[:, 2])
    assert torch.equal(found[:, 0], made.weights[:, 1])
    assert not bool(found[:, [1, 3]].any())


@pytest.mark.parametrize("group", [None, (0, 1, 2)])
def test_one_component_a_class_is_left_as_it_is(group: tuple[int, ...] | None) -> None:
    made = mixture(group)
    assert class_probabilities(made, 3) is made.weights


def test_a_temperature_divides_the_logarithms() -> None:
    logits = torch.randn(2, 5, 3, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(sharpen(logits.softmax(1), 0.4), (logits / 0.4).softmax(1))
    probabilities = logits.softmax(1)
    assert sharpen(probabilities, 1.0) is probabilities


def test_a_class_without_probability_keeps_none() -> None:
    probabilities = torch.tensor([0.0, 0.25, 0.75]).view(1, 3, 1, 1)
    expected = torch.tensor([0.0, 0.1, 0.9])
    torch.testing.assert_close(sharpen(probabilities, 0.5).flatten(), expected)
