"""Run an experiment on built objects, from a program or a notebook."""

import tempfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from benchnav.core.errors import expect
from benchnav.core.progress import show_progress
from benchnav.core.settings import check_known, plain
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.results import Results
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings
from benchnav.planning.free_space import Rules

_NAMES = {field.name for field in fields(Suite)} - {"data"}


def evaluate(
    terrain: str | Path | TerrainDataset | Recipe,
    *,
    folder: str | Path | None = None,
    jobs: int = 1,
    device: str = "auto",
    verbose: bool = True,
    **experiment: Any,
) -> Results:
    """Evaluate each combination of planners, models, risks, … on a dataset's test maps.

    Parts are objects, such as `AStarDWA()` and `CVaR(0.8)`, or names as in suites. Some
    objects cannot be created again by other processes, such as a function without a
    name or a class of a notebook. Such objects run only in this process, the rows of
    their conditions are marked as not reproducible, and their run cannot be resumed.

    Args:
        terrain: a dataset, given by path, id or object; or a recipe, whose test maps
            are generated first.
        folder: run folder; a run that the folder contains is resumed or extended. If
            None, results are stored in a temporary folder, which is deleted with the
            returned object; see `Results.save`.
        jobs: number of worker processes; it does not affect results.
        device: "cpu", "cuda", or "auto" for CUDA if there is a GPU.
        verbose: whether to show progress and notes on stderr.
        **experiment: fields of `Suite`: `models`, `planners`, `risks`, `robots`,
            `objectives`, `sensors`, `grounds`, `beliefs`, `world` (such as
            `World.stakes()`), `task` (or `rules`, a `Rules`), `scenarios`, `maps`,
            `seed` or `seeds`, `realisations`, `record`, `conditions`, `hypotheses`,
            further `metrics` (such as `Energy(power_w=120)`), and custom `figures` for
            the report.

    Returns:
        The results of the run.

    Raises:
        ConfigError: If the combination of parts cannot be run; the message names the
            part and the remedy.
        DatasetError: If the dataset, a split or a map is missing.
    """
    for name in experiment:
        check_known("keywords of `evaluate`", name, {*_NAMES, "rules"})
    if "rules" in experiment:
        rules = experiment.pop("rules")
        expect("task" not in experiment, "`rules` or `task`, got both. Leave one out.")
        experiment["task"] = plain(rules) if isinstance(rules, Rules) else rules
    expect(
        "model" in experiment or "models" in experiment or "conditions" in experiment,
        '`models`, such as [load_model("stakes-v1")], got none. For blind planners, '
        'which use no model, pass models=["oracle"].',
    )
    temporary = None if folder else tempfile.TemporaryDirectory(prefix="benchnav-")
    run_folder = Path(temporary.name, "run") if temporary else Path(str(folder))
    fields_ = {name: _as_tuple(value) for name, value in experiment.items()}
    suite = Suite(data=_path_of(terrain, run_folder), **fields_)
    notes: list[str] = []
    settings = Settings.on(device)
    steps = run_suite(
        suite,
        run_folder,
        jobs,
        settings=settings,
        say=print if verbose else notes.append,
    )
    if verbose:
        show_progress(steps, "units")
    else:
        for _ in steps:
            pass
    return Results(run_folder, temporary)


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _path_of(terrain: Any, run_folder: Path) -> str:
    """Return the path or id of a dataset; generate a recipe's maps next to the run."""
    if isinstance(terrain, TerrainDataset):
        return str(terrain.path)
    if not isinstance(terrain, Recipe):
        return str(terrain)
    splits = {
        name: split
        for name, split in terrain.splits.items()
        if name.startswith("test/")
    }
    path = run_folder.with_name(f"{run_folder.name}-terrain.h5")
    path.parent.mkdir(parents=True, exist_ok=True)
    for _ in create(replace(terrain, splits=splits), path):
        pass
    return str(path)
