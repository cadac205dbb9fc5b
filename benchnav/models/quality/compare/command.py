"""The command `benchnav-train compare`: which of several models predicts best, and whether that is chance."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchnav.core.command import Device
from benchnav.models.quality.output import check_folder, open_maps, save_figures

if TYPE_CHECKING:
    import torch

    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.quality.compare.candidates import Candidate
    from benchnav.models.quality.compare.report import Comparison
    from benchnav.models.quality.measure import Quality

REPORT, CSV, DIFFERENCES, PAGE = "compare.json", "compare.csv", "differences.csv", "compare.md"


def compare(
    models: list[str],
    data: str,
    splits: list[str] | None = None,
    out: str = "",
    seed: int = 0,
    overwrite: bool = False,
    device: Device = "auto",
) -> None:
    """Compare models on the test splits of a dataset: one table, and paired differences by map.

    Args:
        models: Checkpoint folders, or models by NAME, package.module:Name, path/to/file.py:Name or
            path/to/file.py:Name@CHECKPOINT. The privileged models oracle and ideal join them where the truth is known.
        data: Path or id of a dataset.
        splits: Which splits, for example [test/std,valid]; every test split when not given.
        out: Folder for compare.json, compare.csv, differences.csv, compare.md and figures; none when not given.
        seed: Root seed of the draws that place clipped values within their atoms, the same for all models.
        overwrite: Replace a comparison that is in `out`.
        device: Where the models are measured and timed; auto takes CUDA where there is a GPU.
    """
    from benchnav import __version__
    from benchnav.core.progress import show_progress
    from benchnav.core.tables import print_table
    from benchnav.models.config import check_seed

    check_seed(seed)
    folder = Path(out)
    if out:
        check_folder(folder, overwrite, (REPORT, CSV, DIFFERENCES, PAGE), "a comparison")
    dataset = open_maps(data, splits)

    from benchnav.core.device import find_device, gpu_name
    from benchnav.models.quality.compare.candidates import find_candidates
    from benchnav.models.quality.compare.report import comparison_table
    from benchnav.models.quality.measure import known_splits

    place, candidates = find_device(device), find_candidates(models)
    chosen = known_splits(dataset, splits or ())
    pairs = [
        (split, one)
        for split in chosen
        for one in candidates
        if not (one.needs_truth and dataset.truth_of(split) == "unknown")
    ]
    qualities: dict[tuple[str, str], Quality] = {}

    def steps() -> Iterator[tuple[int, int]]:
        from benchnav.models.quality.measure import measure_split

        yield 0, len(pairs)
        for split, one in pairs:
            qualities[split, one.label] = measure_split(one.model, dataset, split, seed, place, by_map=True)
            yield len(qualities), len(pairs)

    show_progress(steps(), "models and splits")
    comparison = _compared(candidates, dataset, chosen, qualities, place)
    named = ", ".join(one.label for one in candidates if one.source in models)
    title = f"{named} on {dataset.id}"
    print_table(comparison_table(title, comparison))
    notes = _notes(candidates, dataset, chosen, qualities, comparison, place)
    for note in notes:
        print(note)
    if not out:
        print(f"columns: --out FOLDER writes {PAGE}, which explains them and lists all differences")
        return
    about = {
        "dataset": {"id": dataset.id, "digest": dataset.digest},
        "seed": seed,
        "device": gpu_name(place) or place.type,
        "threads": _threads(),
        "package_version": __version__,
        "truth": {split: dataset.truth_of(split) for split in chosen},
        "notes": notes,
    }
    _write(out, title, about, comparison, notes)


def _compared(
    candidates: "list[Candidate]",
    dataset: "TerrainDataset",
    splits: list[str],
    qualities: "dict[tuple[str, str], Quality]",
    device: "torch.device",
) -> "Comparison":
    """Compare what was measured, and say what each model costs."""
    import numpy as np

    from benchnav.models.quality.compare.candidates import count_parameters, prediction_ms
    from benchnav.models.quality.compare.report import Comparison, compare_sums
    from benchnav.models.quality.map_sums import by_group

    tallies = {key: quality.by_map for key, quality in qualities.items() if quality.by_map}
    sums: dict[str, dict[str, Any]] = {}
    for split in splits:
        groups: Any = np.arange(dataset.map_count(split))
        if "group" in dataset.field_names:
            groups = dataset.read(split, fields=("group",))["group"].reshape(-1)
        sums[split] = {
            model: by_group(own.sums(), groups) for (of, model), own in tallies.items() if of == split
        }
    summary, pairs, best = compare_sums(sums, [one.label for one in candidates if not one.privileged])
    terrain = dataset.terrain(splits[0], [0]).to(device)
    models = {
        one.label: {
            "source": one.source,
            "privileged": one.privileged,
            "parameters": None if one.privileged else count_parameters(one.model),
            "prediction_ms": None if one.privileged else prediction_ms(one.model, terrain),
        }
        for one in candidates
        if (summary["model"] == one.label).any()
    }
    return Comparison(models=models, summary=summary, pairs=pairs, best=best, tallies=tallies)


def _notes(
    candidates: "list[Candidate]",
    dataset: "TerrainDataset",
    splits: list[str],
    qualities: "dict[tuple[str, str], Quality]",
    comparison: "Comparison",
    device: "torch.device",
) -> list[str]:
    """Says in lines what else a reader has to know of the numbers."""
    from benchnav.core.device import gpu_name
    from benchnav.models.predictor import class_mismatch
    from benchnav.models.quality.baselines import baselines_of
    from benchnav.models.quality.notes import notes_of_data, notes_of_model

    any_classes = [
        split for split in splits if any(q.classes for (of, _), q in qualities.items() if of == split)
    ]
    baselines = baselines_of(dataset, splits, any_classes)
    counts = {split: dataset.map_count(split) for split in splits}
    units = dict(zip(comparison.summary["split"], comparison.summary["units"], strict=True))
    lines = [
        "statistical units: "
        + ", ".join(
            f"{split} {count} maps" + (f" in {units[split]} groups" if units[split] != count else "")
            for split, count in counts.items()
        ),
        *notes_of_data(dataset, splits, baselines),
    ]
    if rivals := sum(not one.privileged for one in candidates) - 1:
        corrected = rivals * (rivals + 1) // 2
        few = [split for split, own in units.items() if corrected * 2.0 ** (1 - own) >= 0.05]
        if few:
            lines.append(f"no difference can be significant with so few maps: {', '.join(few)}")
    if left := [one.label for one in candidates if one.needs_truth]:
        unknown = [split for split in splits if dataset.truth_of(split) == "unknown"]
        if unknown:
            lines.append(
                f"{' and '.join(left)} are left out on {', '.join(unknown)}: the truth is unknown there"
            )
    for one in candidates:
        own = {split: quality for (split, model), quality in qualities.items() if model == one.label}
        if class_mismatch(one.model, dataset.recipe):
            lines.append(f"{one.label} is compared by λ alone: its classes are not those of these maps")
        if not one.privileged:
            own_notes = notes_of_model(one.model, dataset, own, baselines, one.trained_on)
            lines += [f"{one.label}: {line}" for line in own_notes]
    height, width = dataset.grid.shape
    where = gpu_name(device) or f"the CPU with {_threads()} thread{'s' * (_threads() > 1)}"
    lines.append(f"ms a map: median over repeated predictions of a map of {height}×{width} cells on {where}")
    return lines


def _write(out: str, title: str, about: dict[str, Any], comparison: "Comparison", notes: list[str]) -> None:
    from benchnav.core.store import write_text
    from benchnav.models.quality.compare.figures import comparison_figures
    from benchnav.models.quality.compare.report import (
        comparison_csv,
        comparison_json,
        comparison_markdown,
    )

    folder = Path(out)
    write_text(folder / REPORT, comparison_json(about, comparison))
    write_text(folder / CSV, comparison_csv(comparison))
    write_text(folder / DIFFERENCES, comparison.pairs.to_csv(index=False, float_format="%.6g"))
    figures = save_figures(folder, comparison_figures(comparison), comparison)
    write_text(folder / PAGE, comparison_markdown(title, comparison, notes, figures))
    print(f"wrote {REPORT}, {CSV}, {DIFFERENCES}, {PAGE} and {len(figures)} figures in {out}")
    print(f"columns and figures are explained in {folder / PAGE}")


def _threads() -> int:
    import torch

    return torch.get_num_threads()
