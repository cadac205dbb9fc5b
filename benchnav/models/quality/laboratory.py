"""Models measured on splits of a dataset: one by itself, or several that are compared."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchnav.core.device import find_device, gpu_name
from benchnav.core.store import write_text
from benchnav.core.tables import print_table
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.predictor import class_mismatch
from benchnav.models.quality.compare.candidates import (
    Candidate,
    candidate,
    count_parameters,
    find_candidates,
    prediction_ms,
)
from benchnav.models.quality.compare.figures import comparison_figures
from benchnav.models.quality.compare.report import (
    Comparison,
    compare_sums,
    comparison_csv,
    comparison_json,
    comparison_table,
    difference_table,
)
from benchnav.models.quality.figures import QualityData, quality_figures
from benchnav.models.quality.files import COMPARISON, EVALUATION
from benchnav.models.quality.map_sums import by_group
from benchnav.models.quality.measure import choose_splits, known_splits
from benchnav.models.quality.measurement import Measurement
from benchnav.models.quality.output import Page, write_folder
from benchnav.models.quality.report import quality_csv, quality_json, quality_table
from benchnav.stats.holm import ALPHA


def evaluate(
    source: str,
    dataset: TerrainDataset,
    splits: Sequence[str],
    seed: int,
    device: str,
    out: str = "",
    json: str = "",
    maps: int = 3,
) -> None:
    """Measure a model, and print and write how good it is; see
    `command.evaluate_command`.
    """
    one = candidate(source, source)
    chosen = choose_splits(one.model, dataset, splits)
    measurement = Measurement(
        dataset=dataset, splits=chosen, seed=seed, device=find_device(device)
    )
    measurement.measure([(split, one) for split in chosen], "splits", by_map=False)
    qualities, title = measurement.of(one), f"{source} on {dataset.id}"
    print_table(quality_table(title, qualities))
    notes = [*measurement.notes_of_data, *measurement.notes_of(one)]
    print(*notes, sep="\n")
    about = {
        "model": source,
        **measurement.about(notes),
        "nearest_colour_accuracy": measurement.nearest_colour_accuracy,
        "climatology_crps": measurement.climatology_crps,
    }
    report = quality_json(about, qualities)
    if json:
        write_text(Path(json), report)
        print(f"wrote {json}")
    report_file, csv_file, page_file = EVALUATION
    if not out:
        print(f"columns: --out FOLDER writes {page_file}, which explains them")
        return
    name = Path(source).name if Path(source).is_dir() else source
    shown = f"model {name} on dataset {dataset.id}"
    data = QualityData(
        title=shown, model=one.model, dataset=dataset, qualities=qualities, maps=maps
    )
    page = Page(
        title=title,
        tables=[quality_table(title, qualities, whole=True)],
        notes=[*notes, *data.absent],
    )
    for line in data.absent:
        print(line)
    texts = {report_file: report, csv_file: quality_csv(qualities)}
    write_folder(Path(out), texts, page_file, page, quality_figures(data), data)


def compare(
    sources: Sequence[str],
    dataset: TerrainDataset,
    splits: Sequence[str],
    seed: int,
    device: str,
    out: str = "",
) -> None:
    """Compare models, and print and write which is best; see `command.compare`."""
    candidates, chosen = find_candidates(sources), known_splits(dataset, splits)
    measurement = Measurement(
        dataset=dataset, splits=chosen, seed=seed, device=find_device(device)
    )
    # The class table is not the truth of imported ground.
    pairs = [
        (split, one)
        for split in chosen
        for one in candidates
        if not (one.needs_truth and split in measurement.unknown)
    ]
    measurement.measure(pairs, "models and splits", by_map=True)
    comparison = _compared(measurement, candidates)
    title = (
        f"{', '.join(one.label for one in candidates if one.source in sources)} "
        f"on {dataset.id}"
    )
    print_table(comparison_table(title, comparison))
    notes = _notes(measurement, candidates, comparison)
    print(*notes, sep="\n")
    report_file, csv_file, differences_file, page_file = COMPARISON
    if not out:
        print(
            f"columns: --out FOLDER writes {page_file}, which explains them and lists "
            "all differences"
        )
        return
    about = {**measurement.about(notes), "threads": torch.get_num_threads()}
    texts = {
        report_file: comparison_json(about, comparison),
        csv_file: comparison_csv(comparison),
        differences_file: comparison.pairs.to_csv(index=False, float_format="%.6g"),
    }
    tables = [
        comparison_table(title, comparison, whole=True),
        difference_table(comparison),
    ]
    page = Page(
        title=title, tables=[table for table in tables if table.rows], notes=notes
    )
    write_folder(
        Path(out), texts, page_file, page, comparison_figures(comparison), comparison
    )


def _compared(measurement: Measurement, candidates: Sequence[Candidate]) -> Comparison:
    """Compare what was measured, and say what each model costs."""
    dataset = measurement.dataset
    tallies = {
        key: quality.by_map
        for key, quality in measurement.qualities.items()
        if quality.by_map
    }
    sums: dict[str, dict[str, Any]] = {}
    for split in measurement.splits:
        groups: Any = np.arange(dataset.map_count(split))
        if "group" in dataset.field_names:
            groups = dataset.read(split, fields=("group",))["group"].reshape(-1)
        sums[split] = {
            model: by_group(own.sums(), groups)
            for (of, model), own in tallies.items()
            if of == split
        }
    summary, pairs, best = compare_sums(
        sums, [one.label for one in candidates if not one.privileged]
    )
    terrain = dataset.terrain(measurement.splits[0], [0]).to(measurement.device)
    models = {
        one.label: {
            "source": one.source,
            "privileged": one.privileged,
            "parameters": None if one.privileged else count_parameters(one.model),
            "prediction_ms": None
            if one.privileged
            else prediction_ms(one.model, terrain),
        }
        for one in candidates
        if (summary["model"] == one.label).any()
    }
    return Comparison(
        models=models, summary=summary, pairs=pairs, best=best, tallies=tallies
    )


def _notes(
    measurement: Measurement, candidates: Sequence[Candidate], comparison: Comparison
) -> list[str]:
    """Return what else a reader has to know of the numbers of a comparison."""
    dataset = measurement.dataset
    units = dict(
        zip(comparison.summary["split"], comparison.summary["units"], strict=True)
    )
    counts = []
    for split in measurement.splits:
        count = dataset.map_count(split)
        grouped = f" in {units[split]} groups" if units[split] != count else ""
        counts.append(f"{split} {count} maps{grouped}")
    lines = [f"statistical units: {', '.join(counts)}", *measurement.notes_of_data]
    rivals = sum(not one.privileged for one in candidates)
    corrected = rivals * (rivals - 1) // 2
    if few := [
        split for split, own in units.items() if corrected * 2.0 ** (1 - own) >= ALPHA
    ]:
        lines.append(
            f"no difference can be significant with so few maps: {', '.join(few)}"
        )
    left = [one.label for one in candidates if one.needs_truth]
    if left and (unknown := measurement.unknown):
        lines.append(
            f"{' and '.join(left)} are left out on {', '.join(unknown)}: the truth is "
            "unknown there"
        )
    for one in candidates:
        if class_mismatch(one.model, dataset.recipe):
            lines.append(
                f"{one.label} is compared by λ alone: its classes are not those of "
                "these maps"
            )
        if not one.privileged:
            lines += [f"{one.label}: {line}" for line in measurement.notes_of(one)]
    height, width = dataset.grid.shape
    threads = torch.get_num_threads()
    where = (
        gpu_name(measurement.device)
        or f"the CPU with {threads} thread{'s' * (threads > 1)}"
    )
    lines.append(
        f"ms a map: median over repeated predictions of a map of {height}×{width} "
        f"cells on {where}"
    )
    return lines
