"""How unsure class probabilities are, and whether that tells where they are wrong.

The entropy of the prediction is its whole uncertainty. Of an ensemble, the part that its members do
not share (mutual information of class and member, "BALD") is the epistemic one: what more training
data would settle. In nats. Sources: Houlsby et al. (2011), "Bayesian active learning for
classification and preference learning"; Lakshminarayanan et al. (2017), "Simple and scalable
predictive uncertainty estimation using deep ensembles". Letters in shapes: M members, B maps, C
classes, H×W cells.
"""

import torch
from torch import Tensor
from torchmetrics import Metric

_DROPPED_BITS = 13  # of a float32's 23 fraction bits: scores that differ by over 0.1 % are distinct
_PLACES = 2 ** (31 - _DROPPED_BITS)


def predictive_entropy(probabilities: Tensor) -> Tensor:
    """Entropy −Σ_c p_c ln p_c of the class in each cell.

    Args:
        probabilities: summing to 1 over C, shape [*B, C, H, W].

    Returns:
        Nats in [0, ln C], shape [*B, H, W].
    """
    return torch.special.entr(probabilities).sum(-3)


def mutual_information(member_probabilities: Tensor) -> Tensor:
    """Mutual information of class and member: the entropy of the mean less the mean of the entropies.

    Args:
        member_probabilities: of M equally trusted members, shape [M, B, C, H, W].

    Returns:
        Nats in [0, ln min(M, C)], 0 where all members agree, shape [B, H, W].
    """
    members = member_probabilities.double()
    shared = predictive_entropy(members).mean(0)
    return (predictive_entropy(members.mean(0)) - shared).clamp(min=0).to(member_probabilities.dtype)


class ErrorRanking(Metric):
    """AUROC of a score as a sign of error: how often a wrong cell has a higher one than a right cell.

    Scores are counted by size in steps of 0.1 %, fine at every scale, so memory is bounded however many
    cells there are; a tie counts half. torchmetrics' AUROC would need 262 144 thresholds for the same, all of which it
    goes through for each batch.
    """

    full_state_update = False
    counts: Tensor

    def __init__(self) -> None:
        """Starts with no cells."""
        super().__init__()
        self.add_state("counts", torch.zeros(2, _PLACES, dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, score: Tensor, wrong: Tensor) -> None:
        """Adds cells: scores ≥ 0, and whether each is wrongly classified, of one shape."""
        # The bits of a float ≥ 0, read as an integer, are in the order of the floats.
        place = score.float().clamp(min=0).abs().view(torch.int32).long() >> _DROPPED_BITS
        counted = torch.bincount((place + wrong * _PLACES).flatten(), minlength=2 * _PLACES)
        self.counts += counted.view(2, _PLACES)

    def compute(self) -> Tensor:
        """The AUROC in [0, 1], 0.5 for a score that tells nothing; not a number where all or none are wrong."""
        right, wrong = self.counts.double()
        lower = right.cumsum(0) - right / 2
        return (wrong * lower).sum() / (right.sum() * wrong.sum())
