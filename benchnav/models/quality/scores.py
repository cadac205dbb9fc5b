"""Scores of predicted probabilities: of distributions of traversability, of classes,
and of their uncertainty.

Calibration of λ is read off the probability integral transform (PIT) of what was
observed: uniform when the predicted distributions are right. Where the distribution has
an atom, as where λ was clipped, the PIT is drawn uniformly within it, so it is uniform
there too. Sources: Gneiting and Raftery (2007), "Strictly proper scoring rules" (Brier
score); Czado et al. (2009), "Predictive model assessment for count data" (randomised
PIT); Guo et al. (2017), "On calibration of modern neural networks" (reliability, ECE).

The entropy of a prediction is its whole uncertainty. Of an ensemble, the part that its
members do not share (mutual information of class and member, "BALD") is the epistemic
one: what more training
data would settle. In nats. Sources: Houlsby et al. (2011), "Bayesian active learning
for classification and preference learning"; Lakshminarayanan et al. (2017), "Simple and
scalable predictive uncertainty estimation using deep ensembles". Sparsification: Ilg et
al. (2018), "Uncertainty estimates and multi-hypotheses networks for optical flow".

Of classes that look alike, which are shown together, a perfect classifier says 1/2
each. So accuracy is also given with them merged into one class, and of the shares of
the single classes within that one whether they are what they should be.

Letters in shapes: M members, B maps, C classes, G look-alikes, H×W cells, *B any
leading dimensions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchmetrics.functional.classification import multiclass_confusion_matrix

from benchnav.core.distribution import TraversabilityDistribution

LEVEL = 0.9
CONFIDENCE_BINS = 15
PIT_BINS = 20
LOWER_FIFTH = tuple(percent / 100 for percent in range(1, 21))
TAIL_LEVELS = (0.8, 0.9, 0.95)

_DROPPED_BITS = (
    13  # of a float32's 23 fraction bits: scores that differ by over 0.1 % are distinct
)
_PLACES = 2 ** (31 - _DROPPED_BITS)


def pit(
    distribution: TraversabilityDistribution,
    observed: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Randomised probability integral transform of what was observed.

    Args:
        distribution: predicted, of shape [*B, H, W].
        observed: λ in [0, 1], shape [*B, H, W].
        generator: of the draws within atoms, on the CPU.

    Returns:
        Shape [*B, H, W]; uniform on [0, 1] when the prediction is right.
    """
    lower, upper = distribution.cdf_limits(observed)
    drawn = torch.rand(observed.shape, generator=generator).to(observed.device)
    return lower + drawn * (upper - lower)


def coverage(transformed: Tensor) -> float:
    """Share of observations in the central interval that should hold 90 % of them.

    Args:
        transformed: from `pit`, any shape.
    """
    return float(((transformed - 0.5).abs() <= LEVEL / 2).double().mean())


def tail_rate(transformed: Tensor, level: float = LEVEL) -> float:
    """Share of observations under the VaR at a level α; ideally 1 − α.

    Where the VaR is 0 or 1 it lies on an atom, and the draw within the atom decides.

    Args:
        transformed: from `pit`, any shape.
        level: α.
    """
    return float((transformed < 1 - level).double().mean())


def lower_fifth_and_width(
    distribution: TraversabilityDistribution, observed: Tensor
) -> tuple[Tensor, Tensor]:
    """Pinball loss of the lower fifth, and width of the central 90 %.

    The loss is the mean over the levels u = 0.01, 0.02, …, 0.20 of max(u·(λ − Q(u)), (u
    − 1)·(λ − Q(u))), a proper score of these quantiles alone (Koenker and Bassett,
    1978; Gneiting and Raftery, 2007, 6.1).

    Args:
        distribution: predicted, of shape [*B, H, W].
        observed: λ in [0, 1], shape [*B, H, W].

    Returns:
        Loss, and Q(0.95) − Q(0.05), each float64, of shape [*B, H, W].
    """
    loss = torch.zeros_like(observed, dtype=torch.float64)
    low = loss
    for level in LOWER_FIFTH:
        quantile = distribution.quantile(level).double()
        gap = observed - quantile
        loss = loss + torch.maximum(level * gap, (level - 1) * gap) / len(LOWER_FIFTH)
        low = quantile if level == 0.05 else low
    return loss, distribution.quantile(0.95).double() - low


def sparsification(error: Tensor, uncertainty: Tensor) -> Tensor:
    """Mean error of the cells that are left when the most uncertain ones are left out,
    one after another.

    Cells whose uncertainty is within 0.1 % of each other count as equally uncertain, so
    that none of them goes first. The mean of the first row less the second is the area
    under the sparsification error curve (AUSE): 0 where the uncertainty ranks cells as
    their errors do.

    Args:
        error: of each cell, ≥ 0, shape [N].
        uncertainty: of each cell, ≥ 0, shape [N].

    Returns:
        Of the 1, 2, …, N least uncertain cells, and of those with the least error,
        float64, shape [2, N].
    """
    error = error.double()
    _, member = torch.unique(_in_order(uncertainty), return_inverse=True)
    cells = torch.bincount(member)
    tied = torch.bincount(member, error) / cells
    ranked = torch.stack([tied.repeat_interleave(cells), error.sort().values])
    return ranked.cumsum(1) / torch.arange(1, len(error) + 1, device=error.device)


def pit_counts(transformed: Tensor) -> Tensor:
    """Counts observations in 20 equal bins of the PIT.

    Args:
        transformed: from `pit`, any shape.

    Returns:
        int64 on the CPU, shape [20].
    """
    return torch.bincount(
        _bin(transformed.double(), PIT_BINS), minlength=PIT_BINS
    ).cpu()


def brier_score(probabilities: Tensor, class_id: Tensor) -> Tensor:
    """Σ_c (p_c − y_c)² of each cell, y being 1 at the class that is there (Brier,
    1950).

    Args:
        probabilities: shape [B, C, H, W].
        class_id: true classes, int64, shape [B, H, W].

    Returns:
        In [0, 2], shape [B, H, W].
    """
    right = probabilities.gather(1, class_id.unsqueeze(1)).squeeze(1)
    return probabilities.square().sum(1) - 2 * right + 1


def class_scores(confusion: Tensor) -> tuple[float, float, float]:
    """Scores of the most likely classes.

    Args:
        confusion: cells by true class (row) and most likely class (column), int64,
            shape [C, C].

    Returns:
        Accuracy; intersection over union in the mean over the classes that occur in
        truth; and over those that are true or predicted somewhere.
    """
    hits, true = confusion.diagonal().float(), confusion.float().sum(1)
    either = true + confusion.float().sum(0) - hits
    overlap = torch.where(either > 0, hits / either, 0.0)
    accuracy = confusion.diagonal().sum() / confusion.sum()
    return (
        float(accuracy),
        float(overlap[true > 0].mean()),
        float((overlap / (either > 0).sum()).sum()),
    )


class ReliabilityCurve:
    """How often the most likely class is right, by how likely it was said to be, in 15
    equal bins.

    Unlike torchmetrics' calibration error it keeps sums a bin rather than every cell.
    """

    def __init__(self) -> None:
        """Starts with no cells."""
        self.sums = torch.zeros(3, CONFIDENCE_BINS, dtype=torch.float64)

    def update(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Adds maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        confidence, found = probabilities.max(1)
        terms = (
            torch.stack([torch.ones_like(confidence), confidence, found == class_id])
            .double()
            .flatten(1)
        )
        self.sums.index_add_(1, _bin(confidence, CONFIDENCE_BINS).cpu(), terms.cpu())

    def compute(self) -> Tensor:
        """Cells, mean confidence and accuracy of each bin, float64, shape [3, 15]; 0 in
        empty bins.
        """
        cells, confidence, right = self.sums
        filled = cells.clamp(min=1)
        return torch.stack([cells, confidence / filled, right / filled])


def calibration_error(curve: Tensor) -> float:
    """Expected calibration error: |accuracy − confidence| averaged over cells.

    Args:
        curve: of `ReliabilityCurve`, shape [3, 15].
    """
    cells, confidence, accuracy = curve
    return float((cells * (accuracy - confidence).abs()).sum() / cells.sum())


def _bin(values: Tensor, count: int) -> Tensor:
    """The bin of each value among equal ones of [0, 1], int64, shape [N]."""
    return (values * count).floor().long().clamp(0, count - 1).flatten()


def _in_order(score: Tensor) -> Tensor:
    """The place of each score ≥ 0 in steps of 0.1 %, int64, of the same shape."""
    # The bits of a float ≥ 0, read as an integer, are in the order of the floats.
    return score.float().clamp(min=0).abs().view(torch.int32).long() >> _DROPPED_BITS


def predictive_entropy(probabilities: Tensor) -> Tensor:
    """Entropy −Σ_c p_c ln p_c of the class in each cell.

    Args:
        probabilities: summing to 1 over C, shape [*B, C, H, W].

    Returns:
        Nats in [0, ln C], shape [*B, H, W].
    """
    return torch.special.entr(probabilities).sum(-3)


def mutual_information(member_probabilities: Tensor) -> Tensor:
    """Mutual information of class and member: the entropy of the mean less the mean of
    the entropies.

    Args:
        member_probabilities: of M equally trusted members, shape [M, B, C, H, W].

    Returns:
        Nats in [0, ln min(M, C)], 0 where all members agree, shape [B, H, W].
    """
    members = member_probabilities.double()
    shared = predictive_entropy(members).mean(0)
    return (
        (predictive_entropy(members.mean(0)) - shared)
        .clamp(min=0)
        .to(member_probabilities.dtype)
    )


class ErrorRanking:
    """A measure of uncertainty over cells: its mean, and its AUROC as a sign of error.

    That is how often a wrong cell has a higher one than a right cell. Measures are
    counted by size in steps of 0.1 %, fine at every scale, so memory is bounded however
    many cells there are; a tie counts half. torchmetrics' AUROC would need 262 144
    thresholds for the same, all of which it goes through for each batch.
    """

    def __init__(self) -> None:
        """Starts with no cells."""
        self.counts = torch.zeros(2, _PLACES, dtype=torch.int64)
        self.total = 0.0

    def update(self, score: Tensor, wrong: Tensor) -> None:
        """Adds cells: scores ≥ 0, and whether each is wrongly classified, of one shape."""
        counted = torch.bincount(
            (_in_order(score) + wrong * _PLACES).flatten(), minlength=2 * _PLACES
        )
        self.counts += counted.view(2, _PLACES).cpu()
        self.total += float(score.double().sum())

    def compute(self) -> tuple[float, float]:
        """The mean, and the AUROC; neither is a number where there are no cells.

        The AUROC is in [0, 1], 0.5 for a score that tells nothing; not a number where
        all or none are wrong.
        """
        right, wrong = self.counts.double()
        lower = right.cumsum(0) - right / 2
        auroc = (wrong * lower).sum() / (right.sum() * wrong.sum())
        cells = int(self.counts.sum())
        return self.total / cells if cells else math.nan, float(auroc)


@dataclass(frozen=True, kw_only=True)
class LookAlikeQuality:
    """Quality of class probabilities where classes look alike.

    Args:
        look_alike_accuracy: share of cells whose most likely class is right,
            look-alikes merged into one.
        look_alike_miou: intersection over union, look-alikes merged, averaged over the
            classes that occur in truth.
        look_alike_share_error: over the cells of classes with look-alikes, mean
            distance of the share of the true class within them to that which a perfect
            classifier says: 1/2 of two.
        look_alike_share_ece: expected calibration error of the larger share, 15 bins.
    """

    look_alike_accuracy: float
    look_alike_miou: float
    look_alike_share_error: float
    look_alike_share_ece: float


class LookAlikeTally:
    """Counts of class probabilities over maps, look-alikes merged.

    Args:
        alike: of each class those that look like it, itself among them; empty where
            none do.
    """

    def __init__(self, alike: Sequence[tuple[int, ...]]) -> None:
        """Starts with no cells."""
        self.groups = sorted({own for own in alike if len(own) > 1})
        names = sorted({min(own) for own in alike})
        self.merged = torch.tensor([names.index(min(own)) for own in alike])
        self.size = max(2, len(names))  # of fewer there are no scores
        self.confusion = torch.zeros(self.size, self.size, dtype=torch.int64)
        self.curve = ReliabilityCurve()
        self.distance, self.cells = 0.0, 0

    def add(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Adds maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        kinds = self.merged.to(class_id.device)
        merged = torch.zeros_like(probabilities[:, :1]).repeat(1, self.size, 1, 1)
        merged.index_add_(1, kinds, probabilities)
        self.confusion += multiclass_confusion_matrix(
            merged.argmax(1), kinds[class_id], self.size
        ).cpu()
        for group in self.groups:
            # [B, H, W, G]
            match = class_id.unsqueeze(-1) == torch.tensor(
                group, device=class_id.device
            )
            here = match.any(-1)
            own = probabilities[:, list(group)].movedim(1, -1)[here].double()  # [N, G]
            total = own.sum(1, keepdim=True)
            shares = torch.where(total > 0, own / total, 1 / len(group))
            place = match[here].int().argmax(1)
            right = shares.gather(1, place.unsqueeze(1))
            self.distance += float((right - 1 / len(group)).abs().sum())
            self.cells += len(shares)
            self.curve.update(shares.T[None, :, None], place[None, None])

    def quality(self) -> LookAlikeQuality:
        """What was counted; the shares are not a number where no look-alike occurred."""
        accuracy, miou, _ = class_scores(self.confusion)
        return LookAlikeQuality(
            look_alike_accuracy=accuracy,
            look_alike_miou=miou,
            look_alike_share_error=self.distance / self.cells
            if self.cells
            else math.nan,
            look_alike_share_ece=calibration_error(self.curve.compute()),
        )
