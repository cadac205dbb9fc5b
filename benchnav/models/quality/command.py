"""The commands `benchnav-train evaluate` and `benchnav-train compare`: whether models
predict well, and which best.
"""

from pathlib import Path

from benchnav.core.command import Device
from benchnav.models.quality.files import (
    COMPARISON,
    EVALUATION,
    check_writable,
    open_maps,
)


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
        checkpoint: Checkpoint folder, or a model by NAME such as oracle,
            package.module:Name, path/to/file.py:Name or
            path/to/file.py:Name@CHECKPOINT.
        data: Path or id of a dataset.
        splits: Which splits, for example [test/std,valid]; every test split when not
            given.
        out: Folder for quality.json, quality.csv, quality.md and figures; none when not
            given.
        json: File for what quality.json holds, without the rest.
        maps: How many maps of each split the map sheets among the figures show; all
            maps are measured.
        seed: Root seed of the draws that place clipped values within their atoms.
        overwrite: Replace an evaluation that is in `out`.
        device: Where the model is measured; auto takes CUDA where there is a GPU.
            Figures are made on the CPU.
    """
    from benchnav.core.errors import expect

    expect(maps >= 0, f"`maps` ≥ 0, got {maps}. 0 leaves the map sheets out.")
    target = Path(json)
    if json:
        expect(
            target.parent.is_dir() and not target.is_dir(),
            f"`json` to be a file in a folder that exists, got {target}. Make "
            f"{target.parent} first.",
        )
        check_writable(target)
    dataset = open_maps(data, splits, seed, out, overwrite, EVALUATION, "an evaluation")

    from benchnav.models.quality.laboratory import evaluate

    evaluate(
        checkpoint, dataset, splits or (), seed, device, out=out, json=json, maps=maps
    )


def compare(
    models: list[str],
    data: str,
    splits: list[str] | None = None,
    out: str = "",
    seed: int = 0,
    overwrite: bool = False,
    device: Device = "auto",
) -> None:
    """Compare models on the test splits of a dataset: one table, and paired differences
    by map.

    Args:
        models: Checkpoint folders, or models by NAME, package.module:Name,
            path/to/file.py:Name or path/to/file.py:Name@CHECKPOINT. The privileged
            models oracle and ideal join them where the truth is known.
        data: Path or id of a dataset.
        splits: Which splits, for example [test/std,valid]; every test split when not
            given.
        out: Folder for compare.json, compare.csv, differences.csv, compare.md and
            figures; none when not given.
        seed: Root seed of the draws that place clipped values within their atoms, the
            same for all models.
        overwrite: Replace a comparison that is in `out`.
        device: Where the models are measured and timed; auto takes CUDA where there is
            a GPU.
    """
    dataset = open_maps(data, splits, seed, out, overwrite, COMPARISON, "a comparison")

    from benchnav.models.quality.laboratory import compare as compare_models

    compare_models(models, dataset, splits or (), seed, device, out=out)
