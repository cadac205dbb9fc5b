"""The commands `evaluate` and `compare`: measure one model, or compare several."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchnav.core.device import find_device, gpu_name
from benchnav.core.store import write_text
from benchnav.core.tables import print_table
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.predictor import class_mismatch
from benchnav.models.quality.compare.candidates import (
    Candidate,
    count_parameters,
    find_candidates,
    load_candidate,
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
from benchnav.models.quality.figure_data import QualityData
from benchnav.models.quality.figures import quality_figures
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
    """Measure a model, and print and write its quality; see `command.evaluate_command`."""
    candidate = load_candidate(source, source)
    chosen = choose_splits(candidate.model, dataset, splits)
    measurement = Measurement(
        dataset=dataset, splits=chosen, seed=seed, device=find_device(device)
    )
    pairs = [(split, candidate) for split in chosen]
    measurement.measure(pairs, "splits", by_map=False)
    qualities = measurement.of(candidate)
    title = f"{source} on {dataset.id}"
    print_table(quality_table(title, qualities))
    notes = [*measurement.notes_of_data, *measurement.notes_of(candidate)]
    print(*notes, sep="\n")
    header = {
        "model": source,
        **measurement.header(notes),
        "nearest_colour_accuracy": measurement.nearest_colour_accuracy,
        "climatology_crps": measurement.climatology_crps,
    }
    report = quality_json(header, qualities)
    if json:
        write_text(Path(json), report)
        print(f"wrote {json}")
    report_file, csv_file, page_file = EVALUATION
    if not out:
        print(f"to explain the columns, --out FOLDER writes {page_file}")
        return
    name = Path(source).name if Path(source).is_dir() else source
    data = QualityData(
        title=f"model {name} on dataset {dataset.id}",
        model=candidate.model,
        dataset=dataset,
        qualities=qualities,
        maps=maps,
    )
    table = quality_table(title, qualities, all_columns=True)
    page = Page(title=title, tables=[table], notes=[*notes, *data.absent])
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
    """Compare models, and print and write scores and differences; see `command.compare`."""
    candidates = find_candidates(sources)
    chosen = known_splits(dataset, splits)
    measurement = Measurement(
        dataset=dataset, splits=chosen, seed=seed, device=find_device(device)
    )
    unknown = measurement.unknown
    pairs = []
    for split in chosen:
        for candidate in candidates:
            # The class table is not the truth of imported terrain.
            if split in unknown and candidate.needs_truth:
                continue
            pairs.append((split, candidate))
    measurement.measure(pairs, "models and splits", by_map=True)
    comparison = _compare(measurement, candidates)
    requested = [candidate for candidate in candidates if candidate.source in sources]
    labels = [candidate.label for candidate in requested]
    title = f"{', '.join(labels)} on {dataset.id}"
    print_table(comparison_table(title, comparison))
    notes = _notes(measurement, candidates, comparison)
    print(*notes, sep="\n")
    report_file, csv_file, differences_file, page_file = COMPARISON
    if not out:
        print(
            f"to explain the columns and list all differences, --out FOLDER writes "
            f"{page_file}"
        )
        return
    header = {**measurement.header(notes), "threads": torch.get_num_threads()}
    texts = {
        report_file: comparison_json(header, comparison),
        csv_file: comparison_csv(comparison),
        differences_file: comparison.pairs.to_csv(index=False, float_format="%.6g"),
    }
    scores = comparison_table(title, comparison, all_columns=True)
    differences = difference_table(comparison)
    tables = [table for table in (scores, differences) if table.rows]
    page = Page(title=title, tables=tables, notes=notes)
    figures = comparison_figures(comparison)
    write_folder(Path(out), texts, page_file, page, figures, comparison)


def _compare(measurement: Measurement, candidates: Sequence[Candidate]) -> Comparison:
    """Compare the measured models, and measure their costs."""
    dataset = measurement.dataset
    groups = {split: _groups(dataset, split) for split in measurement.splits}
    sums: dict[str, dict[str, Any]] = {split: {} for split in measurement.splits}
    tallies = {}
    for (split, model), quality in measurement.qualities.items():
        tally = quality.by_map
        if tally is not None:
            tallies[split, model] = tally
            sums[split][model] = by_group(tally.sums(), groups[split])
    rivals = [candidate for candidate in candidates if not candidate.privileged]
    competing = [candidate.label for candidate in rivals]
    summary, pairs, best = compare_sums(sums, competing)
    first_map = dataset.terrain(measurement.splits[0], [0])
    terrain = first_map.to(measurement.device)
    models = {}
    for candidate in candidates:
        is_measured = (summary["model"] == candidate.label).any()
        if is_measured:
            models[candidate.label] = _cost(candidate, terrain)
    return Comparison(
        models=models, summary=summary, pairs=pairs, best=best, tallies=tallies
    )


def _groups(dataset: TerrainDataset, split: str) -> np.ndarray:
    """Return the group id of each map, shape [M]."""
    if "group" not in dataset.field_names:
        return np.arange(dataset.map_count(split))
    groups: np.ndarray = dataset.read(split, fields=("group",))["group"]
    return groups.reshape(-1)


def _cost(candidate: Candidate, terrain: Terrain) -> dict[str, Any]:
    """Return source and costs of a model; the costs of privileged models are None."""
    parameters = None
    milliseconds = None
    if not candidate.privileged:
        parameters = count_parameters(candidate.model)
        milliseconds = prediction_ms(candidate.model, terrain)
    return {
        "source": candidate.source,
        "privileged": candidate.privileged,
        "parameters": parameters,
        "prediction_ms": milliseconds,
    }


def _notes(
    measurement: Measurement, candidates: Sequence[Candidate], comparison: Comparison
) -> list[str]:
    """Return notes for readers of the numbers of a comparison."""
    dataset = measurement.dataset
    summary = comparison.summary
    n_units = dict(zip(summary["split"], summary["units"], strict=True))
    counts = []
    for split in measurement.splits:
        n_maps = dataset.map_count(split)
        is_grouped = n_units[split] != n_maps
        groups = f" in {n_units[split]} groups" if is_grouped else ""
        counts.append(f"{split} {n_maps} maps{groups}")
    lines = [f"statistical units: {', '.join(counts)}", *measurement.notes_of_data]
    n_competing = sum(not candidate.privileged for candidate in candidates)
    n_tests = n_competing * (n_competing - 1) // 2
    # With n units, the minimum p-value of a sign-flip permutation test is 2^(1 − n).
    too_few = []
    for split, n in n_units.items():
        min_p = 2.0 ** (1 - n)
        if n_tests * min_p >= ALPHA:
            too_few.append(split)
    if too_few:
        lines.append(
            f"too few maps for any difference to be significant: {', '.join(too_few)}"
        )
    left_out = [candidate.label for candidate in candidates if candidate.needs_truth]
    if left_out and measurement.unknown:
        models = " and ".join(left_out)
        splits = ", ".join(measurement.unknown)
        lines.append(
            f"{models} are left out on {splits}, where the true distribution is unknown"
        )
    for candidate in candidates:
        if class_mismatch(candidate.model, dataset.recipe):
            lines.append(
                f"{candidate.label} is compared only by λ, since its classes differ from "
                "those of the maps"
            )
        if not candidate.privileged:
            notes = measurement.notes_of(candidate)
            lines += [f"{candidate.label}: {note}" for note in notes]
    height, width = dataset.grid.shape
    threads = torch.get_num_threads()
    plural = "s" if threads > 1 else ""
    cpu = f"the CPU with {threads} thread{plural}"
    lines.append(
        f"ms per map: median over repeated predictions of a map of {height}×{width} "
        f"cells on {gpu_name(measurement.device) or cpu}"
    )
    return lines
