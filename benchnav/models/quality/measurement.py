"""Measurements of models on splits of a dataset, with notes on how to read them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
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
    """Measurements of several models.

    Args:
        dataset: dataset of the maps.
        splits: names of the splits to measure.
        seed: root seed of the random PIT values within atoms, the same for all models.
        device: device on which models are measured.
        qualities: quality by split and label of the model.
    """

    dataset: TerrainDataset
    splits: Sequence[str]
    seed: int
    device: torch.device
    qualities: dict[tuple[str, str], Quality] = field(default_factory=dict)

    def measure(
        self, pairs: Sequence[tuple[str, Candidate]], unit: str, by_map: bool
    ) -> None:
        """Measure models on splits, with a progress line.

        Args:
            pairs: pairs of a split and a model.
            unit: name of the pairs in the progress line.
            by_map: whether to store sums by map for a comparison.
        """

        def steps() -> Iterator[tuple[int, int]]:
            yield 0, len(pairs)
            for count, (split, candidate) in enumerate(pairs, 1):
                quality = measure_split(
                    candidate.model,
                    self.dataset,
                    split,
                    self.seed,
                    self.device,
                    by_map=by_map,
                )
                self.qualities[split, candidate.label] = quality
                yield count, len(pairs)

        show_progress(steps(), unit)

    def of(self, candidate: Candidate) -> dict[str, Quality]:
        """Return the qualities of a model by split."""
        return {
            split: quality
            for (split, label), quality in self.qualities.items()
            if label == candidate.label
        }

    @cached_property
    def nearest_colour_accuracy(self) -> dict[str, float]:
        """Fraction of cells that the nearest colour classifies correctly, by split.

        Splits on which no classes were measured are left out.
        """
        has_classes = {
            split for (split, _), quality in self.qualities.items() if quality.classes
        }
        accuracies = {}
        for split in self.splits:
            if split in has_classes:
                accuracy = baselines.nearest_colour_accuracy(self.dataset, split)
                accuracies[split] = accuracy
        return accuracies

    @cached_property
    def climatology_crps(self) -> dict[str, float]:
        """CRPS of predicting the split's distribution of λ in every cell, by split."""
        return {
            split: baselines.climatology_crps(self.dataset, split)
            for split in self.splits
        }

    @property
    def unknown(self) -> list[str]:
        """Names of the splits whose true distribution of λ is unknown."""
        return [
            split for split in self.splits if self.dataset.truth_of(split) == "unknown"
        ]

    @property
    def notes_of_data(self) -> list[str]:
        """Notes on the maps for readers of the numbers."""
        lines = []
        if self.nearest_colour_accuracy:
            accuracies = _listed(self.nearest_colour_accuracy)
            lines.append(
                "baseline without a model, class of the nearest colour: accuracy "
                f"{accuracies}"
            )
        lines.append(
            "baseline without a model, one distribution of λ for all cells: CRPS "
            f"{_listed(self.climatology_crps)}"
        )
        if self.unknown:
            parts = []
            for split in self.unknown:
                parts += self.dataset.splits[split]["parts"]
            sources = [part.get("source", {}) for part in parts]
            observed = (
                "λ that is at least partly drawn from the class table, not measured"
            )
            if all(source.get("traversability") for source in sources):
                observed = "measured λ"
            lines.append(
                f"the true distribution of λ is unknown on {', '.join(self.unknown)}: "
                "RMSE E[λ] is a dash, and RMSE λ, NLL, CRPS, “in 90 %” and “< VaR” are "
                f"computed against {observed}"
            )
        return lines

    def notes_of(self, candidate: Candidate) -> list[str]:
        """Return warnings about poor or misleading numbers of a model."""
        qualities = self.of(candidate)
        warnings = []
        less_accurate = []
        worse = []
        for split, quality in qualities.items():
            for classes in quality.classes:
                if classes.accuracy < self.nearest_colour_accuracy[split]:
                    less_accurate.append(split)
            if quality.traversability.crps > self.climatology_crps[split]:
                worse.append(split)
        if less_accurate:
            splits = ", ".join(less_accurate)
            warnings.append(
                f"the model's accuracy is below that of the nearest colour on {splits}"
            )
        if worse:
            splits = ", ".join(worse)
            warnings.append(
                "the model's CRPS is worse than that of one distribution for all "
                f"cells on {splits}"
            )
        seen = self._seen_splits(candidate, qualities)
        if seen:
            warnings.append(
                "the model was trained, or selected and calibrated, on the maps of "
                f"{', '.join(seen)}: these numbers are not valid for new maps"
            )
        unknown = [split for split in self.unknown if split in qualities]
        if unknown and candidate.needs_truth:
            warnings.append(
                f"on {', '.join(unknown)} this model predicts from the class table of the "
                "recipe, not from the ground truth"
            )
        return [f"warning: {line}" for line in warnings]

    def _seen_splits(self, candidate: Candidate, splits: Iterable[str]) -> list[str]:
        """Return the splits on which a model was trained, with their names in training."""
        seen = []
        for split in splits:
            # Checkpoints of earlier versions contain only the digest of the arrays.
            array_digest = self.dataset.splits[split]["digest"]
            for digest in (self.dataset.split_digest(split), array_digest):
                name = candidate.trained_on.get(digest)
                if name is not None:
                    seen.append(f"{split} (its {name})")
        return seen

    def header(self, notes: Sequence[str]) -> dict[str, Any]:
        """Return information on maps, machine and notes, for JSON files."""
        return {
            "dataset": {"id": self.dataset.id, "digest": self.dataset.digest},
            "seed": self.seed,
            "device": gpu_name(self.device) or self.device.type,
            "package_version": __version__,
            "truth": {split: self.dataset.truth_of(split) for split in self.splits},
            "notes": notes,
        }


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{split} {value:.4f}" for split, value in values.items())
