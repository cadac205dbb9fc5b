"""Which cells may be of one of two look-alike classes, and what is predicted of them
under either.

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
from benchnav.planning.sensing.belief import Law

# of a cell's weight: the pair's, and each of its classes'
_LEAST_MASS, _LEAST_CLASS = (
    0.05,
    0.01,
)


def statistics_of(law: Law) -> GroundStatistics:
    """The statistics of the ground, which say what looks alike.

    Raises:
        ConfigError: there are none.
    """
    expect(
        law.statistics is not None,
        "statistics of the ground, which say which classes look alike, got none. Take "
        "a model that has them, or the "
        "belief copula.",
    )
    return cast(GroundStatistics, law.statistics)


def split(
    prior: TraversabilityDistribution, law: Law
) -> tuple[TraversabilityMixture, TraversabilityMixture, Tensor, Tensor]:
    """Splits a prediction by the label of cells.

    Args:
        prior: of shape [B, H, W].
        law: which classes look alike.

    Returns:
        The prediction under the first and under the second class of each cell's pair;
        the number of that pair, from 1, 0 for none, int64; and the log odds of its
        first class, float64, 0 for none; each of shape [B, H, W]. Components that
        belong to no class are none of a pair's.

    Raises:
        ConfigError: the prediction tells no classes, or the law does not say which look
            alike.
    """
    names, pairs = law.class_names, statistics_of(law).look_alikes
    if not isinstance(prior, TraversabilityMixture) or prior.group is None:
        raise ConfigError(
            "Expected a mixture whose components belong to classes for the belief "
            "classes, got "
            f"{type(prior).__name__}{' without `group`' if isinstance(prior, TraversabilityMixture) else ''}. "
            "Take another model, or the belief copula."
        )
    strange = sorted({name for pair in pairs for name in pair} - set(names))
    expect(
        not strange,
        f"look-alike classes among those of the prediction, got {', '.join(strange)}.",
    )
    pair = torch.zeros(prior.shape, dtype=torch.int64, device=prior.device)
    odds = torch.zeros(prior.shape, dtype=torch.float64, device=prior.device)
    if not pairs:
        return prior, prior, pair, odds
    weights = prior.weights.double()
    shares = replace(
        prior, weights=weights / weights.sum(-3, keepdim=True)
    ).class_probabilities(len(names))
    group = torch.tensor(prior.group, device=prior.device).view(-1, 1, 1)
    heaviest = torch.full_like(odds, _LEAST_MASS)
    scales = [torch.ones_like(weights), torch.ones_like(weights)]
    for number, names_of in enumerate(pairs, 1):
        ids = names.index(names_of[0]), names.index(names_of[1])
        first, second = (shares[:, own] for own in ids)
        mass = first + second
        own = (mass >= heaviest) & (torch.minimum(first, second) > _LEAST_CLASS)
        heaviest, pair = (
            torch.where(own, mass, heaviest),
            torch.where(own, number, pair),
        )
        odds = torch.where(own, (first / second).log(), odds)
        for place, (kept, share) in enumerate(zip(ids, (first, second), strict=True)):
            scale = torch.where(
                group == kept,
                (mass / share)[:, None],
                torch.where(group == sum(ids) - kept, 0.0, 1.0),
            )
            scales[place] = torch.where(own[:, None], scale, scales[place])
    one, other = (
        replace(prior, weights=(weights * scale).to(prior.dtype)) for scale in scales
    )
    return one, other, pair, odds
