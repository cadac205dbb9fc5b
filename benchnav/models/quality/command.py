"""Commands `benchnav-train evaluate` and `compare`: quality of models' predictions."""

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
        splits: Names of splits, for example [test/std,valid]. If empty, all test splits.
        out: Folder for quality.json, quality.csv, quality.md and figures. If empty,
            nothing is written.
        json: File for the content of quality.json only.
        maps: Number of maps of each split that the map sheets show; all maps are measured.
        seed: Root seed of the PIT values, which are random where λ is clipped to 0 or 1.
        overwrite: Replace an existing evaluation in `out`.
        device: Device for the measurement; auto uses CUDA if there is a GPU. Figures are
            drawn on the CPU.
    """
    from benchnav.core.errors import expect

    expect(maps >= 0, f"`maps` ≥ 0, got {maps}. Pass 0 to draw no map sheets.")
    if json:
        target = Path(json)
        is_file_path = target.parent.is_dir() and not target.is_dir()
        expect(
            is_file_path,
            f"`json` to be a file in an existing folder, got {target}. Create "
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
    """Compare models on a dataset's test splits: scores and paired differences per map.

    Args:
        models: Checkpoint folders, or models by NAME, package.module:Name,
            path/to/file.py:Name or path/to/file.py:Name@CHECKPOINT. The privileged
            models oracle and ideal are added if the truth is available.
        data: Path or id of a dataset.
        splits: Names of splits, for example [test/std,valid]. If empty, all test splits.
        out: Folder for compare.json, compare.csv, differences.csv, compare.md and
            figures. If empty, nothing is written.
        seed: Root seed of the PIT values, which are random where λ is clipped to 0 or 1;
            the random numbers are the same for all models.
        overwrite: Replace an existing comparison in `out`.
        device: Device for measuring and timing; auto uses CUDA if there is a GPU.
    """
    dataset = open_maps(data, splits, seed, out, overwrite, COMPARISON, "a comparison")

    from benchnav.models.quality.laboratory import compare as compare_models

    compare_models(models, dataset, splits or (), seed, device, out=out)
