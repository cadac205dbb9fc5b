"""Pairs of look-alike classes: the cells of each pair, and predictions by class.

Letters in shapes: B episodes, H×W cells.
"""

from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError, expect
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.sensing.belief import CovarianceModel

# Minimum weight of a pair of classes in a cell, and of each of its two classes.
_MIN_PAIR_WEIGHT = 0.05
_MIN_CLASS_WEIGHT = 0.01


def statistics_of(covariance: CovarianceModel) -> GroundStatistics:
    """Return the statistics of the training maps, which list the look-alike classes.

    Raises:
        ConfigError: If the covariance model has no statistics.
    """
    expect(
        covariance.statistics is not None,
        "`CovarianceModel.statistics` with the look-alike classes, got None. Use a "
        "model that has terrain statistics, or the belief 'copula'.",
    )
    return cast(GroundStatistics, covariance.statistics)


def split_by_class(
    prior: TraversabilityDistribution, covariance: CovarianceModel
) -> tuple[TraversabilityMixture, TraversabilityMixture, Tensor, Tensor]:
    """Return the predictions under either class of each cell's look-alike pair.

    Args:
        prior: the model's prediction, shape [B, H, W].
        covariance: the covariance model; its statistics list the look-alike classes.

    Returns:
        The prediction under the first class of each cell's pair; the prediction under
        the second class; the index of the pair from 1, int64, 0 without a pair; and the
        log odds of the first class, float64, 0 without a pair. Each has the shape
        [B, H, W]. Components without a class are in both predictions.

    Raises:
        ConfigError: If the prediction has no classes, or the statistics do not list the
            look-alike classes.
    """
    names = covariance.class_names
    pairs = statistics_of(covariance).look_alikes
    is_mixture = isinstance(prior, TraversabilityMixture)
    if not isinstance(prior, TraversabilityMixture) or prior.group is None:
        suffix = " without `group`" if is_mixture else ""
        raise ConfigError(
            "Expected a TraversabilityMixture with `group` for the belief 'classes', "
            f"got {type(prior).__name__}{suffix}. `group` gives the class of each "
            "component. Use another model, or the belief 'copula'."
        )
    paired_names = {name for pair in pairs for name in pair}
    unknown = sorted(paired_names - set(names))
    expect(
        not unknown,
        "look-alike classes that are classes of the prediction "
        f"({', '.join(names)}), got {', '.join(unknown)}. Use another model.",
    )
    pair = torch.zeros(prior.shape, dtype=torch.int64, device=prior.device)
    log_odds = torch.zeros(prior.shape, dtype=torch.float64, device=prior.device)
    if not pairs:
        return prior, prior, pair, log_odds
    weights = prior.weights.double()
    normalised_weights = weights / weights.sum(-3, keepdim=True)
    normalised = replace(prior, weights=normalised_weights)
    probabilities = normalised.class_probabilities(len(names))
    group = torch.tensor(prior.group, device=prior.device).view(-1, 1, 1)
    max_weight = torch.full_like(log_odds, _MIN_PAIR_WEIGHT)
    scales = [torch.ones_like(weights), torch.ones_like(weights)]
    for index, (first_name, second_name) in enumerate(pairs, 1):
        ids = names.index(first_name), names.index(second_name)
        first = probabilities[:, ids[0]]
        second = probabilities[:, ids[1]]
        pair_weight = first + second
        both_likely = torch.minimum(first, second) > _MIN_CLASS_WEIGHT
        is_in_pair = (pair_weight >= max_weight) & both_likely
        max_weight = torch.where(is_in_pair, pair_weight, max_weight)
        pair = torch.where(is_in_pair, index, pair)
        log_odds = torch.where(is_in_pair, (first / second).log(), log_odds)
        for class_index, probability in enumerate((first, second)):
            # This class takes all of the pair's weight; the other class has none.
            excluded_id = ids[1 - class_index]
            others = torch.where(group == excluded_id, 0.0, 1.0)
            scale_of_class = (pair_weight / probability)[:, None]
            scale = torch.where(group == ids[class_index], scale_of_class, others)
            scales[class_index] = torch.where(
                is_in_pair[:, None], scale, scales[class_index]
            )
    first_weights = (weights * scales[0]).to(prior.dtype)
    second_weights = (weights * scales[1]).to(prior.dtype)
    under_first = replace(prior, weights=first_weights)
    under_second = replace(prior, weights=second_weights)
    return under_first, under_second, pair, log_odds
