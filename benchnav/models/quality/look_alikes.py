"""Classes that look alike: how good class probabilities are where no colour tells two classes apart.

Of look-alikes, which are shown together, a perfect classifier says 1/2 each. So accuracy is also given
with them merged into one class, and of the shares of the single classes within that one it is told
whether they are what they should be. Letters in shapes: B maps, H×W cells, C classes, G look-alikes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchmetrics import MetricCollection
from torchmetrics.classification import MulticlassAccuracy

from benchnav.models.nets.classifier import MeanIoU
from benchnav.models.quality.scores import ReliabilityCurve, calibration_error


@dataclass(frozen=True, kw_only=True)
class LookAlikeQuality:
    """Quality of class probabilities where classes look alike.

    Args:
        look_alike_accuracy: share of cells whose most likely class is right, look-alikes merged into one.
        look_alike_miou: intersection over union, look-alikes merged, averaged over the classes that occur in truth.
        look_alike_share_error: over the cells of classes with look-alikes, mean distance of the share of the
            true class within them to that which a perfect classifier says: 1/2 of two.
        look_alike_share_ece: expected calibration error of the larger share, 15 bins.
    """

    look_alike_accuracy: float
    look_alike_miou: float
    look_alike_share_error: float
    look_alike_share_ece: float


class LookAlikeTally:
    """Counts of class probabilities over maps, look-alikes merged.

    Args:
        alike: of each class those that look like it, itself among them.
        device: where the maps are.
    """

    def __init__(self, alike: Sequence[tuple[int, ...]], device: torch.device) -> None:
        """Starts with no cells."""
        self.groups = sorted({own for own in alike if len(own) > 1})
        names = sorted({min(own) for own in alike})
        count = max(2, len(names))  # of fewer there are no scores
        self.merged = torch.tensor([names.index(min(own)) for own in alike], device=device)
        self.scores = MetricCollection(
            {
                "accuracy": MulticlassAccuracy(count, average="micro"),
                "miou": MeanIoU(count),
            }
        ).to(device)
        self.curve = ReliabilityCurve().to(device)
        self.distance, self.cells = 0.0, 0

    def add(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Adds maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        size = int(self.merged.max()) + 1
        shape = (len(probabilities), size, *probabilities.shape[2:])
        merged = torch.zeros(shape, device=probabilities.device, dtype=probabilities.dtype)
        merged.index_add_(1, self.merged, probabilities)
        self.scores.update(merged.argmax(1), self.merged[class_id])
        for group in self.groups:
            self._add_shares(probabilities[:, list(group)], class_id, group)

    def _add_shares(self, probabilities: Tensor, class_id: Tensor, group: tuple[int, ...]) -> None:
        """Adds the shares within one set of look-alikes, [B, G, H, W], of the cells that are of them."""
        here = torch.isin(class_id, torch.tensor(group, device=class_id.device))
        if not bool(here.any()):
            return
        own = probabilities.movedim(1, -1)[here].double()  # [N, G]
        total = own.sum(1, keepdim=True)
        shares = torch.where(total > 0, own / total, 1 / len(group))
        place = (class_id[here].unsqueeze(1) == torch.tensor(group, device=class_id.device)).int().argmax(1)
        right = shares.gather(1, place.unsqueeze(1))
        self.distance += float((right - 1 / len(group)).abs().sum())
        self.cells += len(shares)
        self.curve.update(shares.T[None, :, None], place[None, None])

    def quality(self) -> LookAlikeQuality:
        """What was counted; the shares are not a number where no look-alike occurred."""
        scores = self.scores.compute()
        missing = float("nan")
        return LookAlikeQuality(
            look_alike_accuracy=float(scores["accuracy"]),
            look_alike_miou=float(scores["miou"]),
            look_alike_share_error=self.distance / self.cells if self.cells else missing,
            look_alike_share_ece=calibration_error(self.curve.compute().cpu()) if self.cells else missing,
        )
