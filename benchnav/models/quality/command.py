"""The command `benchnav-train evaluate`: whether a model's probabilities can be trusted."""

from collections.abc import Iterator
from pathlib import Path

from benchnav.core.command import Device
from benchnav.models.quality.output import check_folder, check_writable, open_maps, save_figures

REPORT, CSV, PAGE = "quality.json", "quality.csv", "quality.md"


def evaluate_command(
    checkpoint: str,
    data: str,
    splits: list[str] | None = None,
    out: str = "",
    json: str = "",
    maps: int = 3,
    seed: int = 0,
    overwrite: bool = False,
    device: Device = "auto",
) -> None:
    """Measure a model on the test splits of a dataset.

    Args:
        checkpoint: Checkpoint folder, or a model by NAME such as oracle, package.module:Name, path/to/file.py:Name or
            path/to/file.py:Name@CHECKPOINT.
        data: Path or id of a dataset.
        splits: Which splits, for example [test/std,valid]; every test split when not given.
        out: Folder for quality.json, quality.csv, quality.md and figures; none when not given.
        json: File for what quality.json holds, without the rest.
        maps: How many maps of each split the map sheets among the figures show; all maps are measured.
        seed: Root seed of the draws that place clipped values within their atoms.
        overwrite: Replace an evaluation that is in `out`.
        device: Where the model is measured; auto takes CUDA where there is a GPU. Figures are made on the CPU.
    """
    from benchnav import __version__
    from benchnav.core.errors import expect
    from benchnav.core.progress import show_progress
    from benchnav.core.store import write_text
    from benchnav.core.tables import print_table
    from benchnav.models.config import check_seed

    check_seed(seed)
    expect(maps >= 0, f"`maps` ≥ 0, got {maps}. 0 leaves the map sheets out.")
    target, folder = Path(json), Path(out)
    if json:
        expect(
            target.parent.is_dir() and not target.is_dir(),
            f"`json` to be a file in a folder that exists, got {target}. Make {target.parent} first.",
        )
        check_writable(target)
    if out:
        check_folder(folder, overwrite, (REPORT, CSV, PAGE), "an evaluation")
    dataset = open_maps(data, splits)

    from benchnav.core.device import find_device
    from benchnav.models.predictor import load_model, trained_on
    from benchnav.models.quality.baselines import baselines_of
    from benchnav.models.quality.figures import QualityData, quality_figures
    from benchnav.models.quality.measure import choose_splits
    from benchnav.models.quality.measure import evaluate as evaluate_model
    from benchnav.models.quality.notes import notes_of_data, notes_of_model
    from benchnav.models.quality.report import (
        quality_csv,
        quality_json,
        quality_markdown,
        quality_table,
    )

    place, model = find_device(device), load_model(checkpoint)
    chosen = choose_splits(model, dataset, splits or ())
    qualities = {}

    def steps() -> Iterator[tuple[int, int]]:
        yield 0, len(chosen)
        for split, quality in evaluate_model(model, dataset, chosen, seed, place):
            qualities[split] = quality
            yield len(qualities), len(chosen)

    show_progress(steps(), "splits")
    title = f"{checkpoint} on {dataset.id}"
    print_table(quality_table(title, qualities))
    with_classes = [split for split, quality in qualities.items() if quality.classes]
    baselines = baselines_of(dataset, chosen, with_classes)
    notes = notes_of_data(dataset, chosen, baselines)
    notes += notes_of_model(model, dataset, qualities, baselines, trained_on(checkpoint))
    for note in notes:
        print(note)
    about = {
        "model": checkpoint,
        "dataset": {"id": dataset.id, "digest": dataset.digest},
        "seed": seed,
        "device": place.type,
        "package_version": __version__,
        "nearest_colour_accuracy": baselines.nearest_colour_accuracy,
        "climatology_crps": baselines.climatology_crps,
        "truth": {split: dataset.truth_of(split) for split in chosen},
        "notes": notes,
    }
    report = quality_json(about, qualities)
    if json:
        write_text(target, report)
        print(f"wrote {json}")
    if not out:
        print(f"columns: --out FOLDER writes {PAGE}, which explains them")
        return
    write_text(folder / REPORT, report)
    write_text(folder / CSV, quality_csv(qualities))
    name = Path(checkpoint).name if Path(checkpoint).is_dir() else checkpoint
    shown = f"model {name} on dataset {dataset.id}"
    measured = QualityData(title=shown, model=model, dataset=dataset, qualities=qualities, maps=maps)
    figures = save_figures(folder, quality_figures(measured), measured)
    write_text(folder / PAGE, quality_markdown(title, qualities, notes + measured.absent, figures))
    for line in measured.absent:
        print(line)
    print(f"wrote {REPORT}, {CSV}, {PAGE} and {len(figures)} figures in {out}")
    print(f"columns and figures are explained in {folder / PAGE}")
