"""Which cells may be of which pair of look-alike classes, and what is refused."""

from dataclasses import replace

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.sensing.classes import Classes
from tests.planning.sensing.made_classes import (
    NAMES,
    covariance_of,
    even,
    prediction,
)


def test_a_cell_is_of_the_heavier_pair_and_of_none_that_has_little() -> None:
    weights = torch.zeros(1, 5, 3, 5, dtype=torch.float64)
    weights[0, :, 0, 0] = torch.tensor([0.3, 0.3, 0.0, 0.2, 0.2])
    weights[0, :, 0, 1] = torch.tensor([0.2, 0.2, 0.0, 0.3, 0.3])
    weights[0, :, 0, 2] = torch.tensor([0.02, 0.02, 0.96, 0.0, 0.0])
    weights[0, :, 0, 3] = torch.tensor([0.995, 0.005, 0.0, 0.0, 0.0])
    weights[0, :, 0, 4] = torch.tensor([0.04, 0.02, 0.94, 0.0, 0.0])
    state = Classes().init(prediction(weights), covariance_of(3, 5))
    assert state.pair[0, 0].tolist() == [1, 2, 0, 0, 1]
    # What the other classes have stays theirs under either.
    first, second = (look.prior for look in state.per_class)
    assert isinstance(first, TraversabilityMixture)
    assert isinstance(second, TraversabilityMixture)
    wanted = torch.tensor([0.6, 0.0, 0.0, 0.2, 0.2]).double()
    torch.testing.assert_close(first.weights[0, :, 0, 0], wanted)
    torch.testing.assert_close(second.weights[0, :, 0, 0], wanted[[1, 0, 2, 3, 4]])


def test_predictions_and_laws_without_classes_are_refused() -> None:
    prior, covariance = even(1, 4, 4), covariance_of(4, 4)
    with pytest.raises(ConfigError, match="without `group`"):
        Classes().init(replace(prior, group=None), covariance)
    with pytest.raises(ConfigError, match="statistics"):
        Classes().init(prior, replace(covariance, statistics=None))
    with pytest.raises(ConfigError, match="drift, firm"):
        Classes().init(prior, replace(covariance, class_names=NAMES[:3]))
    with pytest.raises(ConfigError, match="strength"):
        Classes(strength=-1.0)
    with pytest.raises(ConfigError, match="window"):
        Classes(window=0)
