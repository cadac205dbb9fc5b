"""Scores of predictions: distributions of λ, class probabilities, and uncertainty.

Calibration of λ is measured by the probability integral transform (PIT) of the
observations, which is uniform if the predicted distributions are correct. If λ has an
atom, such as at 0 or 1 due to clipping, the PIT is drawn uniformly within the jump of the
CDF, so that it remains uniform. Sources: Gneiting and Raftery (2007), "Strictly proper
scoring rules, prediction, and estimation" (Brier score); Czado et al. (2009),
"Predictive model assessment for count data" (randomised PIT); Guo et al. (2017), "On
calibration of modern neural networks" (reliability, ECE).

The entropy of a prediction, in nats, is its total uncertainty. For an ensemble, the
mutual information of class and member ("BALD") is the epistemic part, which more
training data would reduce. Sources: Houlsby et al. (2011), "Bayesian active learning
for classification and preference learning"; Lakshminarayanan et al. (2017), "Simple and
scalable predictive uncertainty estimation using deep ensembles". Sparsification: Ilg et
al. (2018), "Uncertainty estimates and multi-hypotheses networks for optical flow".

A perfect classifier predicts 1/2 for each of two look-alike classes. Accuracy is
therefore also computed with look-alikes merged into one class, and the probabilities
within the merged class are scored separately.

Letters in shapes: M members, B maps, C classes, G look-alikes, H×W cells, N cells, *B
any leading dimensions.
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

# Of the 23 fraction bits of a float32; scores that differ by over 0.1 % remain distinct.
_DROPPED_BITS = 13
_N_STEPS = 2 ** (31 - _DROPPED_BITS)


def pit(
    distribution: TraversabilityDistribution,
    observed: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return the randomised probability integral transform of the observations.

    Args:
        distribution: predictions, of shape [*B, H, W].
        observed: λ in [0, 1], shape [*B, H, W].
        generator: generator of the random PIT values within atoms, on the CPU.

    Returns:
        PIT values of shape [*B, H, W], uniform on [0, 1] if the predictions are correct.
    """
    lower, upper = distribution.cdf_limits(observed)
    uniform = torch.rand(observed.shape, generator=generator).to(observed.device)
    return lower + uniform * (upper - lower)


def coverage(transformed: Tensor) -> float:
    """Return the fraction of observations in the central 90 % interval.

    Args:
        transformed: PIT of the observations from `pit`, any shape.
    """
    is_inside = (transformed - 0.5).abs() <= LEVEL / 2
    return float(is_inside.double().mean())


def tail_rate(transformed: Tensor, level: float = LEVEL) -> float:
    """Return the fraction of observations below the VaR at level α; ideally 1 − α.

    If the VaR is at an atom, observations at the atom count by their random PIT values.

    Args:
        transformed: PIT of the observations from `pit`, any shape.
        level: level α of the VaR, in (0, 1).
    """
    is_below = transformed < 1 - level
    return float(is_below.double().mean())


def pinball_loss_and_width(
    distribution: TraversabilityDistribution, observed: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the pinball loss of quantiles up to 0.2, and the central interval's width.

    The loss is the mean over the levels u = 0.01, 0.02, …, 0.20 of max(u·(λ − Q(u)), (u
    − 1)·(λ − Q(u))), a proper score of these quantiles. The interval contains 90 % of the
    probability. Sources: Koenker and Bassett (1978), "Regression quantiles"; Gneiting and
    Raftery (2007), 6.1.

    Args:
        distribution: predictions, of shape [*B, H, W].
        observed: λ in [0, 1], shape [*B, H, W].

    Returns:
        Loss and width Q(0.95) − Q(0.05), each float64, of shape [*B, H, W].
    """
    loss = torch.zeros_like(observed, dtype=torch.float64)
    lower = loss
    for level in LOWER_FIFTH:
        quantile = distribution.quantile(level).double()
        error = observed - quantile
        pinball = torch.maximum(level * error, (level - 1) * error)  # u·e or (u − 1)·e
        loss = loss + pinball / len(LOWER_FIFTH)
        if level == 0.05:
            lower = quantile
    upper = distribution.quantile(0.95).double()
    return loss, upper - lower


def sparsification(error: Tensor, uncertainty: Tensor) -> Tensor:
    """Return the mean error of the remaining cells as uncertain cells are removed.

    Cells whose uncertainties differ by less than 0.1 % are tied: each has the mean
    error of the tied cells. The mean of the first row minus the mean of the second row
    is the area under the sparsification error curve (AUSE). It is 0 if uncertainties
    rank cells as errors do.

    Args:
        error: error of each cell, ≥ 0, shape [N].
        uncertainty: uncertainty of each cell, ≥ 0, shape [N].

    Returns:
        Mean errors of the 1, 2, …, N least uncertain cells, and of the 1, 2, …, N cells
        with the smallest errors, float64, shape [2, N].
    """
    error = error.double()
    _, group = torch.unique(_score_step(uncertainty), return_inverse=True)
    n_tied = torch.bincount(group)
    tied_error = torch.bincount(group, error) / n_tied
    by_uncertainty = tied_error.repeat_interleave(n_tied)
    by_error = error.sort().values
    ranked = torch.stack([by_uncertainty, by_error])
    n_cells = torch.arange(1, len(error) + 1, device=error.device)
    return ranked.cumsum(1) / n_cells


def pit_counts(transformed: Tensor) -> Tensor:
    """Count observations in 20 equal bins of the PIT.

    Args:
        transformed: PIT of the observations from `pit`, any shape.

    Returns:
        Counts, int64 on the CPU, shape [20].
    """
    bins = _bin(transformed.double(), PIT_BINS)
    return torch.bincount(bins, minlength=PIT_BINS).cpu()


def brier_score(probabilities: Tensor, class_id: Tensor) -> Tensor:
    """Return Σ_c (p_c − y_c)² of each cell, with y = 1 at the true class.

    Source: Brier (1950), "Verification of forecasts expressed in terms of probability".

    Args:
        probabilities: class probabilities, shape [B, C, H, W].
        class_id: true classes, int64, shape [B, H, W].

    Returns:
        Scores in [0, 2], shape [B, H, W].
    """
    true_probability = probabilities.gather(1, class_id.unsqueeze(1)).squeeze(1)
    return probabilities.square().sum(1) - 2 * true_probability + 1


def class_scores(confusion: Tensor) -> tuple[float, float, float]:
    """Return accuracy and mean intersection over union of the most likely classes.

    Args:
        confusion: number of cells by true class (row) and most likely class (column),
            int64, shape [C, C].

    Returns:
        Accuracy; intersection over union averaged over the classes that are true in any
        cell; and averaged over the classes that are true or predicted in any cell.
    """
    hits = confusion.diagonal().float()
    true = confusion.float().sum(1)
    predicted = confusion.float().sum(0)
    union = true + predicted - hits
    overlap = torch.where(union > 0, hits / union, 0.0)
    accuracy = float(confusion.diagonal().sum() / confusion.sum())
    miou = float(overlap[true > 0].mean())
    n_classes = (union > 0).sum()
    miou_predicted = float((overlap / n_classes).sum())
    return accuracy, miou, miou_predicted


class ReliabilityCurve:
    """Accuracy of the most likely class by its probability, in 15 equal bins.

    It stores sums per bin; torchmetrics' calibration error would store all cells.
    """

    def __init__(self) -> None:
        """Create the curve without cells."""
        self.sums = torch.zeros(3, CONFIDENCE_BINS, dtype=torch.float64)

    def update(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Add maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        confidence, predicted = probabilities.max(1)
        is_correct = predicted == class_id
        terms = torch.stack([torch.ones_like(confidence), confidence, is_correct])
        bins = _bin(confidence, CONFIDENCE_BINS).cpu()
        self.sums.index_add_(1, bins, terms.double().flatten(1).cpu())

    def compute(self) -> Tensor:
        """Return number of cells, mean confidence and accuracy per bin.

        Returns:
            float64, shape [3, 15]; confidence and accuracy are 0 in empty bins.
        """
        cells, confidence, correct = self.sums
        divisor = cells.clamp(min=1)
        return torch.stack([cells, confidence / divisor, correct / divisor])


def calibration_error(curve: Tensor) -> float:
    """Return the expected calibration error, the mean |accuracy − confidence| over cells.

    Args:
        curve: result of `ReliabilityCurve.compute`, shape [3, 15].
    """
    cells, confidence, accuracy = curve
    gaps = (accuracy - confidence).abs()
    return float((cells * gaps).sum() / cells.sum())


def _bin(values: Tensor, count: int) -> Tensor:
    """Return the bin of each value among equal bins of [0, 1], int64, shape [N]."""
    bins = (values * count).floor().long()
    return bins.clamp(0, count - 1).flatten()


def _score_step(score: Tensor) -> Tensor:
    """Return the index of each score ≥ 0 on a scale in steps of 0.1 %, int64."""
    # The bits of floats ≥ 0, read as integers, are in the order of the floats.
    bits = score.float().clamp(min=0).abs().view(torch.int32)
    return bits.long() >> _DROPPED_BITS


def predictive_entropy(probabilities: Tensor) -> Tensor:
    """Return the entropy −Σ_c p_c ln p_c of the class in each cell.

    Args:
        probabilities: class probabilities, which sum to 1 over C, shape [*B, C, H, W].

    Returns:
        Entropy in nats, in [0, ln C], shape [*B, H, W].
    """
    return torch.special.entr(probabilities).sum(-3)


def mutual_information(member_probabilities: Tensor) -> Tensor:
    """Return the mutual information of class and member of an ensemble.

    This is the entropy of the mean prediction minus the mean entropy of the members.

    Args:
        member_probabilities: class probabilities of M members with equal weights, shape
            [M, B, C, H, W].

    Returns:
        Mutual information in nats, in [0, ln min(M, C)], 0 if all members agree; shape
        [B, H, W].
    """
    members = member_probabilities.double()
    mean_entropy = predictive_entropy(members).mean(0)
    total_entropy = predictive_entropy(members.mean(0))
    information = total_entropy - mean_entropy
    return information.clamp(min=0).to(member_probabilities.dtype)


class ErrorRanking:
    """Mean of an uncertainty score over cells, and its AUROC for misclassified cells.

    The AUROC is the probability that a misclassified cell has a higher score than a
    correctly classified cell; a tie counts half. Scores are counted in relative steps of
    0.1 %, so memory does not grow with the number of cells. torchmetrics' AUROC would
    need 262 144 thresholds for this resolution, in a loop for each batch.
    """

    def __init__(self) -> None:
        """Create the ranking without cells."""
        self.counts = torch.zeros(2, _N_STEPS, dtype=torch.int64)
        self.total = 0.0

    def update(self, score: Tensor, wrong: Tensor) -> None:
        """Add cells: scores ≥ 0, and a mask of misclassified cells of the same shape."""
        index = (_score_step(score) + wrong * _N_STEPS).flatten()
        counts = torch.bincount(index, minlength=2 * _N_STEPS)
        self.counts += counts.view(2, _N_STEPS).cpu()
        self.total += float(score.double().sum())

    def compute(self) -> tuple[float, float]:
        """Return the mean score and the AUROC; both are NaN if no cells were added.

        The AUROC is in [0, 1], and 0.5 for a score without information. It is NaN if all
        cells or no cells are misclassified.
        """
        correct, wrong = self.counts.double()
        n_lower = correct.cumsum(0) - correct / 2
        n_ordered_pairs = (wrong * n_lower).sum()
        n_pairs = correct.sum() * wrong.sum()
        auroc = n_ordered_pairs / n_pairs
        n_cells = int(self.counts.sum())
        mean = self.total / n_cells if n_cells else math.nan
        return mean, float(auroc)


@dataclass(frozen=True, kw_only=True)
class LookAlikeQuality:
    """Quality of class probabilities with respect to look-alike classes.

    Args:
        look_alike_accuracy: fraction of cells whose most likely class is correct, with
            look-alikes merged into one class.
        look_alike_miou: intersection over union with look-alikes merged, averaged over
            the classes that are true in any cell.
        look_alike_share_error: mean distance of the true class's fraction of the
            probability of its group of look-alikes from the fraction that a perfect
            classifier predicts, 1/2 in a group of two.
        look_alike_share_ece: expected calibration error of the largest such fraction in a
            group, from 15 bins.
    """

    look_alike_accuracy: float
    look_alike_miou: float
    look_alike_share_error: float
    look_alike_share_ece: float


class LookAlikeTally:
    """Sums over maps for the quality of look-alike classes.

    Args:
        alike: ids of each class and its look-alikes, by class; empty if no classes look
            alike.
    """

    def __init__(self, alike: Sequence[tuple[int, ...]]) -> None:
        """Create the tally without cells."""
        self.groups = sorted({group for group in alike if len(group) > 1})
        first_classes = sorted({min(group) for group in alike})
        merged = [first_classes.index(min(group)) for group in alike]
        self.merged = torch.tensor(merged)
        self.size = max(2, len(first_classes))  # scores need two classes
        self.confusion = torch.zeros(self.size, self.size, dtype=torch.int64)
        self.curve = ReliabilityCurve()
        self.distance = 0.0
        self.cells = 0

    def add(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Add maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        merged_id = self.merged.to(class_id.device)
        merged = torch.zeros_like(probabilities[:, :1]).repeat(1, self.size, 1, 1)
        merged.index_add_(1, merged_id, probabilities)
        predicted = merged.argmax(1)
        true = merged_id[class_id]
        confusion = multiclass_confusion_matrix(predicted, true, self.size)
        self.confusion += confusion.cpu()
        for group in self.groups:
            members = torch.tensor(group, device=class_id.device)
            is_member = class_id.unsqueeze(-1) == members  # [B, H, W, G]
            mask = is_member.any(-1)
            group_probabilities = probabilities[:, list(group)].movedim(1, -1)
            joint = group_probabilities[mask].double()  # [N, G]
            total = joint.sum(1, keepdim=True)
            equal_fraction = 1 / len(group)
            fractions = torch.where(total > 0, joint / total, equal_fraction)
            true_index = is_member[mask].int().argmax(1)
            true_fraction = fractions.gather(1, true_index.unsqueeze(1))
            distance = (true_fraction - equal_fraction).abs()
            self.distance += float(distance.sum())
            self.cells += len(fractions)
            self.curve.update(fractions.T[None, :, None], true_index[None, None])

    def quality(self) -> LookAlikeQuality:
        """Return the quality; errors of fractions are NaN if no look-alike class occurs."""
        accuracy, miou, _ = class_scores(self.confusion)
        error = self.distance / self.cells if self.cells else math.nan
        return LookAlikeQuality(
            look_alike_accuracy=accuracy,
            look_alike_miou=miou,
            look_alike_share_error=error,
            look_alike_share_ece=calibration_error(self.curve.compute()),
        )
