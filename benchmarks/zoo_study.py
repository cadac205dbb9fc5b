"""Does a model with a lower loss get the robot to its goal more often? Quality varied on purpose, and what it is worth.

    python benchmarks/zoo_study.py runs/zoo                 # hours; killed and begun again it goes on
    python benchmarks/zoo_study.py runs/zoo --parts inputs  # one part alone
    python benchmarks/zoo_study.py runs/try --maps 4 --sizes 10 --seeds 0     # minutes, to see that all runs

Parts, each of whose steps is kept and not done again:

- `doses`: the hypothesis of `benchmarks/zoo_study.yaml`. Maps, checkpoints (one for each size and seed), quality of
  every model on the maps that are driven on, one suite, tables and the test.
- `zoo`: every uncertainty method on `stakes-v1`, compared on `test/std` and `test/hs`, and driven with as in `doses`.
- `paper`: every method on `paper-v1`, one seed, compared and not driven with.
- `inputs`: what elevation and the height of vegetation are worth to the fused model on `vegetation-v1`.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from zoo_report import RISKS, SPLIT, Dose, print_quality, report_doses, report_zoo

from benchnav.core import registry
from benchnav.core.store import write_text
from benchnav.datagen import TerrainDataset
from benchnav.models import load_model
from benchnav.models.base import predict
from benchnav.models.quality.scores import lower_fifth_and_width

HERE = Path(__file__).parent
HYPOTHESIS, VARIED = HERE / "zoo_study.yaml", HERE / "varied.py"
TEMPERATURES, SOFT, BRIGHTNESS = (0.25, 0.5, 1.0, 2.0, 4.0), (0.0, 0.5, 2.0), (0.7, 0.85, 1.15)
CHUNK = 20
TESTS = ("test/std", "test/hs")
PARTS = ("doses", "zoo", "paper", "inputs")
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


def doses(sizes: list[int], seeds: list[int]) -> Iterator[Dose]:
    """All models of the study; soft modes and brightness vary at the largest size alone."""
    for seed in seeds:
        for size in sizes:
            yield from (Dose(size=size, seed=seed, dose=dose) for dose in TEMPERATURES)
        for what, levels in (("soft", SOFT), ("brightness", BRIGHTNESS)):
            yield from (Dose(size=max(sizes), seed=seed, what=what, dose=dose) for dose in levels)


def command(program: str, *words: object) -> None:
    """Runs one of our commands, and says how long it took."""
    begun = time.perf_counter()
    subprocess.run([Path(sys.executable).with_name(program), *map(str, words)], check=True)
    print(f"-- {program} {' '.join(map(str, words[:3]))}: {time.perf_counter() - begun:.0f} s", flush=True)


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


def train(out: Path, sizes: list[int], seeds: list[int]) -> None:
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
    """Runs a suite, or what is left of it; the rows of its episodes."""
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
        (out / f"{name}.yaml").write_text(yaml.safe_dump(suite))
        command("benchnav-eval", "run", "--config", out / f"{name}.yaml", "--out", out / name, "--jobs", 2)
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


def digest() -> str:
    """SHA-256 of the hypothesis."""
    return hashlib.sha256(HYPOTHESIS.read_bytes()).hexdigest()


def run_doses(out: Path, maps: int, draws: int, sizes: list[int], seeds: list[int]) -> None:
    """The hypothesis: quality varied on purpose, measured and driven with."""
    kept = out / "hypothesis.sha256"
    if not kept.exists():
        kept.write_text(digest())
    if kept.read_text() != digest():
        sys.exit(f"Expected the hypothesis that {out} was begun under, {kept.read_text()}, got {digest()}.")
    print(f"hypothesis {digest()}", flush=True)
    models = list(doses(sizes, seeds))
    train(out, sizes, seeds)
    loss = measure(out, models, maps)
    rows = drive(out, "run", [part_of(out, dose) for dose in models], maps, draws)
    report_doses(out, rows, loss, models, digest())


def run_zoo(out: Path, maps: int, draws: int, sizes: list[int], seeds: list[int]) -> None:
    """Every method on `stakes-v1`, compared and driven with."""
    largest, places = max(sizes), {}
    train(out, [largest], seeds)
    for seed in seeds:
        for method, words in METHODS.items():
            place = out / (checkpoint_name(largest, seed) if method == "fused" else f"zoo-{method}-s{seed}")
            places[method, seed] = fit(place, out / f"train-{largest}.h5", words, seed)
    test = make_maps(out / "test.h5", "stakes-v1", dict.fromkeys(TESTS, maps))
    table = compare_methods(out, "zoo", places, test)
    table.to_csv(out / "zoo.csv", index=False)
    print_quality("stakes-v1: mean over seeds", table)
    parts = [{"part": str(place), "label": f"{method}-s{seed}"} for (method, seed), place in places.items()]
    report_zoo(out, drive(out, "run-zoo", parts, maps, draws), table)


def run_quality(
    out: Path, part: str, recipes: tuple[str, str], methods: Methods, maps: int, size: int, seeds: list[int]
) -> None:
    """Methods on the maps of two recipes, to train and to test on, compared alone; differences are to the first."""
    train = training_maps(out / f"{part}-train.h5", recipes[0], size)
    test = make_maps(out / f"{part}-test.h5", recipes[1], dict.fromkeys(TESTS, maps))
    places = {
        (method, seed): fit(out / f"{part}-{method}-s{seed}", train, words, seed)
        for seed in seeds
        for method, words in methods.items()
    }
    table = compare_methods(out, part, places, test)
    table.to_csv(out / f"{part}.csv", index=False)
    print_quality(f"{recipes[0]}: mean over seeds", table)
    if len(seeds) > 1:
        print_quality(f"{recipes[0]}: difference to {next(iter(methods))}", table, next(iter(methods)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 50, 200, 1000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--parts", choices=PARTS, nargs="+", default=PARTS)
    given = parser.parse_args()
    out, begun = given.out.resolve(), time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    make_maps(out / "drive.h5", "stakes-v1", {SPLIT: given.maps})
    largest = max(given.sizes)
    if "doses" in given.parts:
        run_doses(out, given.maps, given.draws, given.sizes, given.seeds)
    if "zoo" in given.parts:
        run_zoo(out, given.maps, given.draws, given.sizes, given.seeds)
    if "paper" in given.parts:
        run_quality(out, "paper", ("paper-v1", "full-v1"), METHODS, given.maps, largest, given.seeds[:1])
    if "inputs" in given.parts:
        run_quality(
            out, "inputs", ("vegetation-v1", "vegetation-v1"), INPUTS, given.maps, largest, given.seeds
        )
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
