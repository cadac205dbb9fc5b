"""Models measured on splits of a dataset, and what a reader of their numbers has to
know, in lines of text.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch

from benchnav import __version__
from benchnav.core.device import gpu_name
from benchnav.core.progress import show_progress
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.quality import baselines
from benchnav.models.quality.compare.candidates import Candidate
from benchnav.models.quality.measure import Quality, measure_split


@dataclass(kw_only=True)
class Measurement:
    """What was measured of some models.

    Args:
        dataset: the maps.
        splits: of it.
        seed: root seed of the draws within atoms, the same for all models.
        device: where models are measured.
        qualities: by split and label of the model.
    """

    dataset: TerrainDataset
    splits: Sequence[str]
    seed: int
    device: torch.device
    qualities: dict[tuple[str, str], Quality] = field(default_factory=dict)

    def measure(
        self, pairs: Sequence[tuple[str, Candidate]], what: str, by_map: bool
    ) -> None:
        """Measure models on splits, with a line of progress.

        Args:
            pairs: split and model.
            what: are counted.
            by_map: keep what a comparison needs.
        """

        def steps() -> Iterator[tuple[int, int]]:
            yield 0, len(pairs)
            for count, (split, one) in enumerate(pairs, 1):
                quality = measure_split(
                    one.model,
                    self.dataset,
                    split,
                    self.seed,
                    self.device,
                    by_map=by_map,
                )
                self.qualities[split, one.label] = quality
                yield count, len(pairs)

        show_progress(steps(), what)

    def of(self, one: Candidate) -> dict[str, Quality]:
        """Return the qualities of a model by split."""
        return {
            split: quality
            for (split, label), quality in self.qualities.items()
            if label == one.label
        }

    @cached_property
    def nearest_colour_accuracy(self) -> dict[str, float]:
        """Fraction of the cells whose class the nearest colour tells, by split on which
        classes were measured.
        """
        classified = {
            split for (split, _), quality in self.qualities.items() if quality.classes
        }
        return {
            split: baselines.nearest_colour_accuracy(self.dataset, split)
            for split in self.splits
            if split in classified
        }

    @cached_property
    def climatology_crps(self) -> dict[str, float]:
        """CRPS of one distribution of λ for all cells, by split."""
        return {
            split: baselines.climatology_crps(self.dataset, split)
            for split in self.splits
        }

    @property
    def unknown(self) -> list[str]:
        """Splits of which the truth is unknown."""
        return [
            split for split in self.splits if self.dataset.truth_of(split) == "unknown"
        ]

    @property
    def notes_of_data(self) -> list[str]:
        """What a reader has to know of the maps."""
        lines = []
        if by_colour := self.nearest_colour_accuracy:
            listed = ", ".join(
                f"{split} {share:.4f}" for split, share in by_colour.items()
            )
            lines.append(
                "baseline without a model, class of the nearest colour: accuracy "
                f"{listed}"
            )
        listed = ", ".join(
            f"{split} {score:.4f}" for split, score in self.climatology_crps.items()
        )
        lines.append(
            "baseline without a model, one distribution of λ for all cells: CRPS "
            f"{listed}"
        )
        if self.unknown:
            parts = [
                part
                for split in self.unknown
                for part in self.dataset.splits[split]["parts"]
            ]
            observed = "λ that the class table drew at least in part, not measured λ"
            if all(part.get("source", {}).get("traversability") for part in parts):
                observed = "measured λ"
            lines.append(
                f"the true distribution of λ is unknown on {', '.join(self.unknown)}: "
                "RMSE E[λ] is a dash, and RMSE λ, "
                f"NLL, CRPS, “in 90 %” and “< VaR” are against {observed}"
            )
        return lines

    def notes_of(self, one: Candidate) -> list[str]:
        """Return warnings of what makes a model's numbers bad or worth nothing."""
        qualities, warnings = self.of(one), []
        by_colour, climatology = self.nearest_colour_accuracy, self.climatology_crps
        less_accurate = [
            split
            for split, quality in qualities.items()
            if any(item.accuracy < by_colour[split] for item in quality.classes)
        ]
        if less_accurate:
            splits = ", ".join(less_accurate)
            warnings.append(
                f"the model's accuracy is below that of the nearest colour on {splits}"
            )
        worse = [
            split
            for split, own in qualities.items()
            if own.traversability.crps > climatology[split]
        ]
        if worse:
            splits = ", ".join(worse)
            warnings.append(
                "the model's CRPS is worse than that of one distribution for all "
                f"cells on {splits}"
            )
        seen = [
            f"{split} (its {one.trained_on[digest]})"
            for split in qualities
            # Checkpoints of earlier versions hold the digest of the arrays alone.
            for digest in (
                self.dataset.split_digest(split),
                self.dataset.splits[split]["digest"],
            )
            if digest in one.trained_on
        ]
        if seen:
            warnings.append(
                "the model was trained, or selected and calibrated, on the maps of "
                f"{', '.join(seen)}: these numbers "
                "do not hold for unseen maps"
            )
        unknown = [split for split in self.unknown if split in qualities]
        if unknown and one.needs_truth:
            warnings.append(
                f"on {', '.join(unknown)} this model gives the class table of the "
                "recipe, not the truth of the ground"
            )
        return [f"warning: {line}" for line in warnings]

    def about(self, notes: Sequence[str]) -> dict[str, Any]:
        """Return what JSON files say of maps and machine."""
        return {
            "dataset": {"id": self.dataset.id, "digest": self.dataset.digest},
            "seed": self.seed,
            "device": gpu_name(self.device) or self.device.type,
            "package_version": __version__,
            "truth": {split: self.dataset.truth_of(split) for split in self.splits},
            "notes": notes,
        }
