"""The command `benchnav-train evaluate`: whether a model's probabilities can be trusted."""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchnav.core.command import Device

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.models.base import TraversabilityModel
    from benchnav.models.quality.measure import Quality

REPORT, CSV, PAGE, FIGURES = "quality.json", "quality.csv", "quality.md", "figures"
DPI = 300


def evaluate(
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
        checkpoint: Checkpoint folder, or a model by NAME such as oracle, package.module:Name or path/to/file.py:Name.
        data: Path or id of a dataset.
        splits: Which splits, for example [test/std,valid]; every test split when not given.
        out: Folder for quality.json, quality.csv, quality.md and figures; none when not given.
        json: File for what quality.json holds, without the rest.
        maps: How many maps of each split the map sheets among the figures show.
        seed: Root seed of the draws that place clipped values within their atoms.
        overwrite: Replace an evaluation that is in `out`.
        device: Where the model is measured; auto takes CUDA where there is a GPU. Figures are made on the CPU.
    """
    from benchnav import __version__
    from benchnav.core.command import show_progress
    from benchnav.core.errors import ConfigError
    from benchnav.core.store import write_text
    from benchnav.core.tables import print_table
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset
    from benchnav.models.config import check_seed

    check_seed(seed)
    if maps < 0:
        raise ConfigError(f"Expected `maps` ≥ 0, got {maps}. 0 leaves the map sheets out.")
    _check_targets(out, json, overwrite)
    dataset = TerrainDataset(find_dataset(data))
    if splits == []:
        raise ConfigError(f"Expected `splits` among {', '.join(dataset.splits)}, got none.")
    for split in splits or ():
        dataset.map_count(split)  # refuses an unknown one before the slow imports

    from benchnav.core.device import find_device
    from benchnav.core.figures import save_twice
    from benchnav.models.predictor import load_model, trained_on
    from benchnav.models.quality.measure import choose_splits, nearest_colour_accuracy
    from benchnav.models.quality.measure import evaluate as evaluate_model
    from benchnav.models.quality.report import quality_csv, quality_json, quality_markdown, quality_table

    place, model = find_device(device), load_model(checkpoint)
    chosen = choose_splits(model, dataset, splits or ())
    qualities: dict[str, Quality] = {}

    def steps() -> Iterator[tuple[int, int]]:
        for split, quality in evaluate_model(model, dataset, chosen, seed, place):
            qualities[split] = quality
            yield len(qualities), len(chosen)

    show_progress(steps(), "splits")
    title = f"{checkpoint} on {dataset.id}"
    print_table(quality_table(title, qualities))
    by_colour: dict[str, float] = {}
    if all(quality.classes for quality in qualities.values()):
        by_colour = {split: nearest_colour_accuracy(dataset, split) for split in chosen}
    notes = [
        *_beside_colour(by_colour, qualities),
        *_seen(dataset, chosen, trained_on(checkpoint)),
        *_without_truth(model, dataset, chosen),
    ]
    for note in notes:
        print(note)
    about = {
        "model": checkpoint,
        "dataset": {"id": dataset.id, "digest": dataset.digest},
        "seed": seed,
        "device": place.type,
        "package_version": __version__,
        "nearest_colour_accuracy": by_colour,
        "truth": {split: dataset.truth_of(split) for split in chosen},
        "notes": notes,
    }
    report = quality_json(about, qualities)
    if json:
        write_text(Path(json), report)
        print(f"wrote {json}")
    if not out:
        print(f"what the columns mean: with --out FOLDER, {PAGE} there says so")
        return
    folder = Path(out)
    write_text(folder / REPORT, report)
    write_text(folder / CSV, quality_csv(qualities))
    for old in (folder / FIGURES).glob("*.p[nd][gf]"):
        old.unlink()
    name = Path(checkpoint).name if Path(checkpoint).is_dir() else checkpoint
    drawn, absent = _figures(f"model {name} on dataset {dataset.id}", model, dataset, qualities, maps)
    paths = [f"{FIGURES}/{figure}.png" for figure in drawn]

    def saved() -> Iterator[tuple[int, int]]:
        for count, (path, draw) in enumerate(zip(paths, drawn.values(), strict=True), 1):
            save_twice(draw(), folder / path, dpi=DPI)
            yield count, len(paths)

    show_progress(saved(), "figures")
    write_text(folder / PAGE, quality_markdown(title, qualities, notes + absent, paths))
    for line in absent:
        print(line)
    print(f"wrote {REPORT}, {CSV}, {PAGE} and {len(paths)} figures in {out}")
    print(f"what the columns and figures mean: {folder / PAGE}")


def _check_targets(out: str, json: str, overwrite: bool) -> None:
    """Refuses what cannot be written to before any work is done."""
    from benchnav.core.errors import ConfigError
    from benchnav.core.store import output_path, refuse_taken

    target, folder = output_path(json), output_path(out)
    if json and (not target.parent.is_dir() or target.is_dir()):
        raise ConfigError(
            f"Expected `json` to be a file in a folder that exists, got {json}. Make {target.parent} first."
        )
    if out:
        refuse_taken(folder, overwrite, _foreign)
    for path in [target] * bool(json) + [folder / REPORT] * bool(out):
        nearest = next(parent for parent in path.absolute().parents if parent.exists())
        try:
            with tempfile.TemporaryFile(dir=nearest):
                pass
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error


def _foreign(folder: Path) -> str:
    """Says why what is at a place is no evaluation; empty where it is one. For `refuse_taken`."""
    own = folder.is_dir() and {item.name for item in folder.iterdir()} <= {REPORT, CSV, PAGE, FIGURES}
    return "" if own else "is something else than an evaluation"


def _beside_colour(by_colour: "Mapping[str, float]", qualities: "Mapping[str, Quality]") -> list[str]:
    """Says how often the nearest colour is right, and where the model is right less often."""
    if not by_colour:
        return []
    listed = ", ".join(f"{split} {share:.4f}" for split, share in by_colour.items())
    lines = [f"accuracy of the class of the nearest colour, without a model: {listed}"]
    worse = [split for split, share in by_colour.items() if qualities[split].classes[0].accuracy < share]
    if worse:
        lines.append(f"warning: the model is right less often than the nearest colour on {', '.join(worse)}")
    return lines


def _seen(dataset: "TerrainDataset", splits: "Sequence[str]", known: "Mapping[str, str]") -> list[str]:
    """Says which splits hold the very maps that the model was trained on, by their digests."""
    # Checkpoints of earlier versions hold the digest of the arrays alone.
    digests = {split: (dataset.split_digest(split), dataset.splits[split]["digest"]) for split in splits}
    found = [
        f"{split} (its {known[digest]})"
        for split, both in digests.items()
        for digest in both
        if digest in known
    ]
    if not found:
        return []
    return [
        f"warning: the model was trained, or chosen and calibrated, on the maps of {', '.join(found)}: their "
        "numbers say nothing of maps that it has not seen"
    ]


def _without_truth(
    model: "TraversabilityModel", dataset: "TerrainDataset", splits: "Sequence[str]"
) -> list[str]:
    """Says what cannot be measured where the truth is unknown, and what is measured in its place."""
    from benchnav.models.predictor import Ideal, Oracle

    unknown = [split for split in splits if dataset.truth_of(split) == "unknown"]
    if not unknown:
        return []
    sources = [part.get("source", {}) for split in unknown for part in dataset.splits[split]["parts"]]
    measured = all(source.get("traversability") for source in sources)
    observed = (
        "measured λ" if measured else "λ that was, at least in part, drawn by the class table, not measured"
    )
    lines = [
        f"RMSE E[λ] is – on {', '.join(unknown)}, since the true distribution of λ is unknown on imported ground; "
        f"RMSE λ, NLL, CRPS, “in 90 %” and “< VaR” there are against {observed}"
    ]
    if isinstance(model, Oracle | Ideal):
        lines.append(
            f"warning: what this model says of {', '.join(unknown)} is the class table of the recipe, not the truth "
            "of this ground"
        )
    return lines


def _figures(
    title: str,
    model: "TraversabilityModel",
    dataset: "TerrainDataset",
    qualities: "Mapping[str, Quality]",
    maps: int,
) -> "tuple[dict[str, Callable[[], Figure]], list[str]]":
    """Gives what draws the figures that apply, by name; and a line for each of those that do not, with why."""
    from functools import partial

    import numpy as np

    from benchnav.datagen.recipe.scenario import find_series
    from benchnav.models.quality import figures, map_sheet
    from benchnav.models.quality.report import sheet_name
    from benchnav.models.slope_gp.table import SlopeTable

    by_class = {split: item for split, quality in qualities.items() for item in quality.classes}
    by_cell = {split: quality.traversability for split, quality in qualities.items()}
    classes, table = dataset.recipe.classes, getattr(model, "table", None)
    drawn: dict[str, Callable[[], Figure]] = {}
    absent = []
    if by_class:
        drawn["confusion"] = partial(figures.confusion_figure, by_class, [item.name for item in classes])
        drawn["reliability"] = partial(figures.reliability_figure, by_class)
    if len(by_class) < len(qualities):
        absent.append("no confusion matrix, reliability diagram or entropy: the model predicts no classes")
    drawn["pit"] = partial(figures.pit_figure, by_cell)
    if all_series := find_series(qualities):
        drawn["severity"] = partial(figures.severity_figure, all_series, qualities)
    if not isinstance(table, SlopeTable):
        absent.append("no latent functions: the model has no Gaussian processes over slope")
    elif by_class:
        cells = sum(np.array(quality.slope_cells) for quality in by_class.values()).tolist()
        known = all(dataset.truth_of(split) == "generated" for split in qualities)
        drawn["latent"] = partial(figures.latent_figure, table, classes, cells, known)
    if not all_series:
        absent.append("no series of shifts: no splits such as test/hg-050 and test/hg-100 were measured")
    if maps:
        sheets = [
            map_sheet.read_sheet(model, dataset, split, range(min(maps, dataset.map_count(split))))
            for split in qualities
        ]
        scales = map_sheet.shared_scales(sheets, classes)
        for sheet in sheets:
            draw = partial(map_sheet.map_sheet_figure, sheet, scales, classes, title)
            drawn[sheet_name(sheet.split)] = draw
    return drawn, absent
