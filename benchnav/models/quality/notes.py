"""What a reader of a model's numbers has to know beside them, in lines of text."""

from collections.abc import Mapping, Sequence

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import TraversabilityModel
from benchnav.models.predictor import Ideal, Oracle
from benchnav.models.quality.baselines import Baselines
from benchnav.models.quality.measure import Quality


def notes_of_data(dataset: TerrainDataset, splits: Sequence[str], baselines: Baselines) -> list[str]:
    """Says in lines what a reader has to know of the maps.

    Args:
        dataset: on what models were measured.
        splits: those of it.
        baselines: what can be said without a model.
    """
    lines = []
    if by_colour := baselines.nearest_colour_accuracy:
        listed = ", ".join(f"{split} {share:.4f}" for split, share in by_colour.items())
        lines.append(f"baseline without a model, class of the nearest colour: accuracy {listed}")
    listed = ", ".join(f"{split} {score:.4f}" for split, score in baselines.climatology_crps.items())
    lines.append(f"baseline without a model, one distribution of λ for all cells: CRPS {listed}")
    if unknown := [split for split in splits if dataset.truth_of(split) == "unknown"]:
        parts = [part for split in unknown for part in dataset.splits[split]["parts"]]
        observed = "λ that the class table drew at least in part, not measured λ"
        if all(part.get("source", {}).get("traversability") for part in parts):
            observed = "measured λ"
        lines.append(
            f"the true distribution of λ is unknown on {', '.join(unknown)}: RMSE E[λ] is a dash, and RMSE λ, NLL, "
            f"CRPS, “in 90 %” and “< VaR” are against {observed}"
        )
    return lines


def notes_of_model(
    model: TraversabilityModel,
    dataset: TerrainDataset,
    qualities: Mapping[str, Quality],
    baselines: Baselines,
    trained_on: Mapping[str, str],
) -> list[str]:
    """Warns in lines of what makes a model's numbers bad or worth nothing.

    Args:
        model: what was measured.
        dataset: on what.
        qualities: by split.
        baselines: what can be said without a model.
        trained_on: names of the splits that the model was trained on, by digest.
    """
    lines = []
    worse = [
        split for split, share in baselines.nearest_colour_accuracy.items()
        if split in qualities and any(item.accuracy < share for item in qualities[split].classes)
    ]  # fmt: skip
    if worse:
        lines.append(
            f"warning: the model's accuracy is below that of the nearest colour on {', '.join(worse)}"
        )
    worse = [
        split for split, quality in qualities.items()
        if quality.traversability.crps > baselines.climatology_crps[split]
    ]  # fmt: skip
    if worse:
        lines.append(
            f"warning: the model's CRPS is worse than that of one distribution for all cells on {', '.join(worse)}"
        )
    seen = [
        f"{split} (its {trained_on[digest]})"
        for split in qualities
        # Checkpoints of earlier versions hold the digest of the arrays alone.
        for digest in (dataset.split_digest(split), dataset.splits[split]["digest"])
        if digest in trained_on
    ]
    if seen:
        lines.append(
            f"warning: the model was trained, or selected and calibrated, on the maps of {', '.join(seen)}: these "
            "numbers do not hold for unseen maps"
        )
    unknown = [split for split in qualities if dataset.truth_of(split) == "unknown"]
    if unknown and isinstance(model, Oracle | Ideal):
        lines.append(
            f"warning: on {', '.join(unknown)} this model gives the class table of the recipe, not the truth of the "
            "ground"
        )
    return lines
