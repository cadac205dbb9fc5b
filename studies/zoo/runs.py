"""Quality of models varied on purpose, and what it is worth to a robot; the methods of the zoo.

Each step is stored in the folder `zoo` of the runs and not done again. `maps`, `sizes` and `seeds` of a part may be
changed in study.yaml, to see in minutes that all runs.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchnav.core import registry
from benchnav.core.errors import expect
from benchnav.core.store import write_text
from benchnav.datagen import TerrainDataset
from benchnav.models import load_model
from benchnav.models.base import predict
from benchnav.models.quality.scores import lower_fifth_and_width
from studies import runs
from studies.runs import command
from studies.study import Work
from studies.zoo.report import RISKS, SPLIT, Dose, doses_results, quality, zoo_results

HERE = Path(__file__).parent
HYPOTHESIS, VARIED = HERE / "hypothesis.yaml", HERE / "varied.py"
TEMPERATURES, SOFT, BRIGHTNESS = (0.25, 0.5, 1.0, 2.0, 4.0), (0.0, 0.5, 2.0), (0.7, 0.85, 1.15)
CHUNK = 20
TESTS = ("test/std", "test/hs")
SIZES, SEEDS = (10, 50, 200, 1000), (0, 1, 2)
Results = dict[str, pd.DataFrame | Figure | str]
# What `benchnav-train fit` is told of each, beside data, folder and seed.
FUSED, JOINED = ("fused", "--settings.classifier.encoder_depth", 3), ("--settings.encoder_depth", 3)
Methods = dict[str, tuple[object, ...]]
METHODS: Methods = {
    "fused": FUSED,
    "mdn": ("mdn", *JOINED),
    "mean_variance": ("mean_variance", *JOINED),
    "quantile": ("quantile", *JOINED),
    "evidential": ("evidential", *JOINED),
    "mc_dropout": ("mc_dropout", *JOINED),
    "swag": ("swag", *JOINED),
    "ensemble": ("mean_variance", *JOINED, "--members", 3),
    "conformal": ("mean_variance", *JOINED, "--conformal", "true"),
}
INPUTS: Methods = {
    name: (*FUSED, "--settings.classifier.inputs", f"[{fields}]")
    for name, fields in (
        ("rgb", "rgb"),
        ("elevation", "rgb,elevation_m"),
        ("slope", "rgb,slope_deg"),
        ("vegetation", "rgb,vegetation_m"),
        ("all", "rgb,elevation_m,slope_deg,vegetation_m"),
    )
}


def models_of(sizes: Sequence[int], seeds: Sequence[int]) -> Iterator[Dose]:
    """All models of the study; soft modes and brightness vary at the largest size alone."""
    for seed in seeds:
        for size in sizes:
            yield from (Dose(size=size, seed=seed, dose=dose) for dose in TEMPERATURES)
        for what, levels in (("soft", SOFT), ("brightness", BRIGHTNESS)):
            yield from (Dose(size=max(sizes), seed=seed, what=what, dose=dose) for dose in levels)


def make_maps(path: Path, recipe: str, counts: dict[str, int]) -> Path:
    """Makes so many maps of the splits of a recipe, if they are not there."""
    if not path.exists():
        sizes = (f"splits.{split}.maps={count}" for split, count in counts.items())
        splits = f"[{','.join(counts)}]"
        command(
            "benchnav-datagen", "create", recipe, f"id={path.stem}", *sizes, "--splits", splits, "--out", path
        )
    return path


def training_maps(path: Path, recipe: str, size: int) -> Path:
    """Maps to train on: of each size the first of the largest."""
    return make_maps(path, recipe, {"train": size, "valid": max(4, size // 4)})


def train(out: Path, sizes: Sequence[int], seeds: Sequence[int]) -> None:
    """Trains what there is not; small sets for more epochs, so that every network takes 100 steps or more."""
    for seed in seeds:
        for size in sizes:
            epochs = max(20, -(-100 // -(-size // 16)))
            longer = {"max_epochs": epochs, "patience": max(10, epochs // 2)}
            words = [
                word for name, value in longer.items() for word in (f"--settings.classifier.{name}", value)
            ]
            data = training_maps(out / f"train-{size}.h5", "stakes-v1", size)
            fit(out / checkpoint_name(size, seed), data, (*FUSED, *words), seed)


def fit(place: Path, data: Path, words: tuple[object, ...], seed: int) -> Path:
    """Trains a checkpoint if it is not finished."""
    done = place.with_suffix(".done")
    if not done.exists():
        command(
            "benchnav-train",
            "fit",
            words[0],
            "--data",
            data,
            "--out",
            place,
            "--resume",
            "--seed",
            seed,
            *words[1:],
        )
        done.touch()
    return place


def checkpoint_name(size: int, seed: int) -> str:
    """Folder of a checkpoint."""
    return f"fused-n{size}-s{seed}"


def part_of(out: Path, dose: Dose) -> dict[str, Any]:
    """A model as suites name it."""
    options = {"checkpoint": str(out / checkpoint_name(dose.size, dose.seed)), dose.what: dose.dose}
    return {"part": f"{VARIED}:Varied", "label": dose.label, "options": options}


def measure(out: Path, models: list[Dose], maps: int) -> pd.Series:
    """Pinball loss of the lower fifth of every model on the maps that are driven on."""
    path = out / f"pinball-{maps}.json"
    found: dict[str, float] = json.loads(path.read_text()) if path.exists() else {}
    dataset = TerrainDataset(out / "drive.h5")
    for dose in models:
        if dose.label in found:
            continue
        model, losses = load_model(registry.read_part("model", part_of(out, dose))), []
        for first in range(0, maps, CHUNK):
            terrain = dataset.terrain(SPLIT, range(first, min(maps, first + CHUNK)))
            loss, _ = lower_fifth_and_width(predict(model, terrain), terrain.traversability)
            losses.append(loss.mean((1, 2)))
        found[dose.label] = float(np.concatenate([loss.numpy() for loss in losses]).mean())
        write_text(path, json.dumps(found, indent=1))
    return pd.Series(found)[[dose.label for dose in models]]


def drive(out: Path, name: str, models: list[dict[str, Any]], maps: int, draws: int) -> pd.DataFrame:
    """Run a suite, or what is missing of it; return the rows of its episodes."""
    suite = {
        "data": str(out / "drive.h5"),
        "world": "stakes",
        "scenarios": [SPLIT.removeprefix("test/")],
        "objectives": ["travel_time"],
        "maps": maps,
        "realisations": draws,
        "record": "none",
        "planners": ["astar_dwa"],
        "risks": list(RISKS),
        "models": models,
    }
    done = out / f"{name}.done"
    if not done.exists():
        runs.drive(suite, out / name, 2)
        done.touch()
    return pd.read_parquet(out / name / "episodes.parquet")


def compare_methods(out: Path, part: str, places: dict[tuple[str, int], Path], data: Path) -> pd.DataFrame:
    """Quality of every method and seed, a row a split, from one `benchnav-train compare` a seed."""
    tables = []
    for seed in sorted({seed for _, seed in places}):
        own = {place.name: method for (method, of), place in places.items() if of == seed}
        folder = out / f"{part}-quality-s{seed}"
        if not (folder / "compare.csv").exists():
            command(
                "benchnav-train", "compare", *(place for (_, of), place in places.items() if of == seed),
                "--data", data, "--splits", f"[{','.join(TESTS)}]", "--out", folder,
            )  # fmt: skip
        table = pd.read_csv(folder / "compare.csv")
        tables.append(table.assign(method=table["model"].map(own).fillna(table["model"]), seed=seed))
    return pd.concat(tables, ignore_index=True)


def begin(work: Work, maps: int) -> Path:
    """Return the folder of all parts, with the maps that are driven on."""
    out = work.out / "zoo"
    out.mkdir(parents=True, exist_ok=True)
    make_maps(out / "drive.h5", "stakes-v1", {SPLIT: maps})
    return out


def doses(
    work: Work,
    folder: Path,
    maps: int = 200,
    draws: int = 2,
    sizes: Sequence[int] = SIZES,
    seeds: Sequence[int] = SEEDS,
) -> Results:
    """Test the hypothesis: quality varied on purpose, measured and driven with.

    Raises:
        ConfigError: If these runs were begun under another hypothesis.
    """
    out, digest = begin(work, maps), runs.digest_of(HYPOTHESIS)
    kept = out / "hypothesis.sha256"
    if not kept.exists():
        kept.write_text(digest)
    expect(
        kept.read_text() == digest,
        f"the hypothesis that {out} was begun under, {kept.read_text()}, got {digest}.",
    )
    print(f"hypothesis {digest}", flush=True)
    models = list(models_of(sizes, seeds))
    train(out, sizes, seeds)
    loss = measure(out, models, maps)
    rows = drive(out, "run", [part_of(out, dose) for dose in models], maps, draws)
    return doses_results(rows, loss, models, digest)


def zoo(
    work: Work,
    folder: Path,
    maps: int = 200,
    draws: int = 2,
    size: int = SIZES[-1],
    seeds: Sequence[int] = SEEDS,
) -> Results:
    """Compare every method on `stakes-v1`, and drive with it."""
    out, places = begin(work, maps), {}
    train(out, [size], seeds)
    for seed in seeds:
        for method, words in METHODS.items():
            place = out / (checkpoint_name(size, seed) if method == "fused" else f"zoo-{method}-s{seed}")
            places[method, seed] = fit(place, out / f"train-{size}.h5", words, seed)
    test = make_maps(out / "test.h5", "stakes-v1", dict.fromkeys(TESTS, maps))
    table = compare_methods(out, "zoo", places, test)
    parts = [{"part": str(place), "label": f"{method}-s{seed}"} for (method, seed), place in places.items()]
    return {"quality": quality(table)} | zoo_results(drive(out, "run-zoo", parts, maps, draws), table)


def paper(work: Work, folder: Path, maps: int = 200, size: int = SIZES[-1]) -> Results:
    """Compare every method on `paper-v1`, with one seed."""
    return _compared(work, "paper", ("paper-v1", "full-v1"), METHODS, maps, size, SEEDS[:1])


def inputs(
    work: Work, folder: Path, maps: int = 200, size: int = SIZES[-1], seeds: Sequence[int] = SEEDS
) -> Results:
    """Compare inputs of the fused model on `vegetation-v1`."""
    return _compared(work, "inputs", ("vegetation-v1", "vegetation-v1"), INPUTS, maps, size, seeds)


def _compared(
    work: Work,
    part: str,
    recipes: tuple[str, str],
    methods: Methods,
    maps: int,
    size: int,
    seeds: Sequence[int],
) -> Results:
    """Compare methods on the maps of two recipes, to train and to test on; differences are to the first method."""
    out = begin(work, maps)
    training = training_maps(out / f"{part}-train.h5", recipes[0], size)
    test = make_maps(out / f"{part}-test.h5", recipes[1], dict.fromkeys(TESTS, maps))
    places = {
        (method, seed): fit(out / f"{part}-{method}-s{seed}", training, words, seed)
        for seed in seeds
        for method, words in methods.items()
    }
    table = compare_methods(out, part, places, test)
    results: Results = {"quality": quality(table)}
    if len(seeds) > 1:
        results["difference"] = quality(table, next(iter(methods)))
    return results
