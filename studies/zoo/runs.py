"""Effect of model quality on success: deliberately varied models, methods of the zoo.

Each step is stored in the folder `zoo` of the runs and is not repeated. To try a part
in minutes, reduce its `maps`, `sizes` and `seeds` in study.yaml.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchnav.core import registry
from benchnav.core.errors import expect
from benchnav.core.store import write_text
from benchnav.datagen import TerrainDataset
from benchnav.models import load_model, predict
from benchnav.models.quality.scores import pinball_loss_and_width
from studies import runs
from studies.runs import command
from studies.study import Work
from studies.zoo.report import RISKS, SPLIT, doses_results, quality, ranked

HERE = Path(__file__).parent
HYPOTHESIS, VARIED = HERE / "hypothesis.yaml", HERE / "varied.py"
DOSES = {
    "temperature": (0.25, 0.5, 1.0, 2.0, 4.0),
    "soft": (0.0, 0.5, 2.0),
    "brightness": (0.7, 0.85, 1.15),
}
FUSED = "fused --settings.classifier.encoder_depth 3"
TESTS = ("test/std", "test/hs")
SIZES, SEEDS = (10, 50, 200, 1000), (0, 1, 2)
RECIPE = "stakes-v1"
Results = dict[str, pd.DataFrame | Figure]


def models_of(sizes: Sequence[int], seeds: Sequence[int]) -> pd.DataFrame:
    """Return all varied models.

    Soft modes and brightness vary only at the largest number of training maps.
    """
    rows = [
        {
            "label": f"n{size}-s{seed}-{what}-{dose:g}",
            "size": size,
            "seed": seed,
            "what": what,
            "dose": dose,
        }
        for seed in seeds
        for what, doses in DOSES.items()
        for size in (sizes if what == "temperature" else (max(sizes),))
        for dose in doses
    ]
    return pd.DataFrame(rows).set_index("label")


def make_maps(path: Path, recipe: str, counts: Mapping[str, int]) -> Path:
    """Create a dataset of a recipe with `counts` maps per split, if it is missing."""
    if not path.exists():
        sizes = (f"splits.{split}.maps={count}" for split, count in counts.items())
        splits = f"[{','.join(counts)}]"
        command(
            "benchnav-datagen",
            "create",
            recipe,
            f"id={path.stem}",
            *sizes,
            "--splits",
            splits,
            "--out",
            path,
        )
    return path


def fit(
    out: Path, name: str, words: str, size: int, seed: int, recipe: str = RECIPE
) -> Path:
    """Train a checkpoint on the first `size` maps of a recipe, unless it is finished."""
    checkpoint = out / f"{recipe}-n{size}-{name}-s{seed}"
    marker = checkpoint.with_suffix(".done")
    if not marker.exists():
        data = out / f"{recipe}-n{size}.h5"
        make_maps(data, recipe, {"train": size, "valid": max(4, size // 4)})
        family, *options = words.split()
        command(
            "benchnav-train",
            "fit",
            family,
            "--data",
            data,
            "--out",
            checkpoint,
            "--resume",
            "--seed",
            seed,
            *options,
        )
        marker.touch()
    return checkpoint


def fit_fused(out: Path, size: int, seed: int) -> Path:
    """Train a fused model for enough epochs that its network takes 100 steps or more."""
    epochs = max(20, -(-100 // -(-size // 16)))
    longer = (
        f"--settings.classifier.max_epochs {epochs} "
        f"--settings.classifier.patience {max(10, epochs // 2)}"
    )
    return fit(out, "fused", f"{FUSED} {longer}", size, seed)


def measure(
    path: Path, parts: list[dict[str, Any]], data: Path, maps: int
) -> pd.Series:
    """Return the pinball loss of the lower fifth of each model on the test maps.

    Losses are stored in `path` and read from there if present.
    """
    loss_by_label: dict[str, float] = (
        json.loads(path.read_text()) if path.exists() else {}
    )
    dataset = TerrainDataset(data)
    for part in parts:
        if part["label"] in loss_by_label:
            continue
        model, losses = load_model(registry.read_part("model", part)), []
        for indices, _ in dataset.chunks(SPLIT, fields=()):
            terrain = dataset.terrain(
                SPLIT, [index for index in indices if index < maps]
            )
            loss, _ = pinball_loss_and_width(
                predict(model, terrain), terrain.traversability
            )
            losses += loss.mean((1, 2)).tolist()
        loss_by_label[part["label"]] = sum(losses) / len(losses)
        write_text(path, json.dumps(loss_by_label, indent=1))
    return pd.Series(loss_by_label)


def drive(
    out: Path, name: str, models: list[dict[str, Any]], maps: int, draws: int
) -> pd.DataFrame:
    """Run the missing units of the suite of these models; return the episodes' rows."""
    suite = {
        "data": str(drive_maps(out, maps)),
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
    runs.drive(suite, out / name, 2)
    return pd.read_parquet(out / name / "episodes.parquet")


def drive_maps(out: Path, maps: int) -> Path:
    """Return the path of the test maps on which robots drive; create them if missing."""
    return make_maps(out / "drive.h5", RECIPE, {SPLIT: maps})


def begin(work: Work) -> Path:
    """Create and return the folder of all parts."""
    out = work.out / "zoo"
    out.mkdir(parents=True, exist_ok=True)
    return out


def doses(
    work: Work,
    folder: Path,
    maps: int = 200,
    draws: int = 2,
    sizes: Sequence[int] = SIZES,
    seeds: Sequence[int] = SEEDS,
) -> Results:
    """Test the hypothesis on deliberately varied models.

    Raises:
        ConfigError: If these runs were started under another hypothesis.
    """
    out, digest = begin(work), runs.digest_of(HYPOTHESIS)
    digest_file = out / "hypothesis.sha256"
    if not digest_file.exists():
        digest_file.write_text(digest)
    stored_digest = digest_file.read_text()
    expect(
        stored_digest == digest,
        f"hypothesis.yaml of SHA-256 {stored_digest}, under which {out} was started, "
        f"got {digest}. Use another `--out`.",
    )
    print(f"hypothesis {digest}", flush=True)
    models = models_of(sizes, seeds)
    parts = []
    for label, fields in models.to_dict("index").items():
        options = {
            "checkpoint": str(fit_fused(out, fields["size"], fields["seed"])),
            fields["what"]: fields["dose"],
        }
        parts.append({"part": f"{VARIED}:Varied", "label": label, "options": options})
    models["loss"] = measure(
        out / f"pinball-{maps}.json", parts, drive_maps(out, maps), maps
    )
    return doses_results(drive(out, "run", parts, maps, draws), models, digest)


def compare(
    work: Work,
    folder: Path,
    methods: dict[str, str],
    recipes: tuple[str, str] = (RECIPE, RECIPE),
    maps: int = 200,
    draws: int = 0,
    size: int = SIZES[-1],
    seeds: Sequence[int] = SEEDS,
) -> Results:
    """Compare methods, trained on maps of one recipe and tested on those of another.

    Differences are to the first method.

    Args:
        work: folders and extent of the work.
        folder: folder of the run.
        methods: arguments of `benchnav-train fit`, by name of the method.
        recipes: recipes of the training maps and of the test maps.
        maps: number of test maps per split.
        draws: number of λ fields per map on which robots drive with each model; if 0,
            no robot drives.
        size: number of training maps.
        seeds: seeds of training.
    """
    out, part = begin(work), folder.name
    test = make_maps(
        out / f"{recipes[1]}-test.h5", recipes[1], dict.fromkeys(TESTS, maps)
    )
    tables, parts = [], []
    for seed in seeds:
        checkpoints = {
            fit(out, method, words, size, seed, recipes[0]): method
            for method, words in methods.items()
        }
        quality_of = out / f"{part}-quality-s{seed}"
        if not (quality_of / "compare.csv").exists():
            splits = f"[{','.join(TESTS)}]"
            command(
                "benchnav-train",
                "compare",
                *checkpoints,
                "--data",
                test,
                "--splits",
                splits,
                "--out",
                quality_of,
            )
        table = pd.read_csv(quality_of / "compare.csv")
        names = table["model"].map(
            {checkpoint.name: method for checkpoint, method in checkpoints.items()}
        )
        tables.append(table.assign(method=names.fillna(table["model"]), seed=seed))
        parts += [
            {"part": str(checkpoint), "label": f"{method}-s{seed}"}
            for checkpoint, method in checkpoints.items()
        ]
    table = pd.concat(tables, ignore_index=True)
    results: Results = {"quality": quality(table)}
    if len(seeds) > 1:
        results["difference"] = quality(table, next(iter(methods)))
    if draws:
        rows = drive(out, f"run-{part}", parts, maps, draws)
        results |= ranked(rows, table, [part["label"] for part in parts])
    return results
