"""Does a better calibrated model get the robot to its goal more often? Quality varied on purpose, and what it is worth.

    python benchmarks/zoo_study.py runs/zoo                 # hours; killed and begun again it goes on
    python benchmarks/zoo_study.py runs/try --maps 4 --sizes 10 --seeds 0     # minutes, to see that all runs

The hypothesis stands in `benchmarks/zoo_study.yaml`. Steps: maps, checkpoints (one for each size and seed), quality of
every model on the maps that are driven on, one suite, tables and the test. Each is kept and not done again.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from rich.console import Console
from rich.table import Table

from benchnav.core import registry
from benchnav.core.resampling import sign_flips
from benchnav.datagen import TerrainDataset
from benchnav.eval.stats.paired_difference import mean_interval
from benchnav.models import load_model
from benchnav.models.base import predict
from benchnav.models.quality.scores import lower_fifth_and_width

HERE = Path(__file__).parent
HYPOTHESIS, VARIED = HERE / "zoo_study.yaml", HERE / "varied.py"
TEMPERATURES, SOFT, BRIGHTNESS = (0.25, 0.5, 1.0, 2.0, 4.0), (0.0, 0.5, 2.0), (0.7, 0.85, 1.15)
RISKS, SPLIT, CHUNK = ("expected-time", "cvar:0.8"), "test/std", 20


@dataclass(frozen=True, kw_only=True)
class Dose:
    """A model of the study: maps that it was trained on, its training seed, and what is changed about it."""

    size: int
    seed: int
    what: str = "temperature"
    dose: float = 1.0

    @property
    def label(self) -> str:
        """Its name in tables."""
        return f"n{self.size}-s{self.seed}-{self.what}-{self.dose:g}"


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


def make_maps(out: Path, sizes: list[int]) -> None:
    """Makes the maps to drive on, and those to train on: of each size the first of the largest."""
    if not (out / "drive.h5").exists():
        command(
            "benchnav-datagen", "create", "stakes-v1", "--splits", f"[{SPLIT}]", "--out", out / "drive.h5"
        )
    for size in sizes:
        if not (out / f"train-{size}.h5").exists():
            changes = (
                f"id=stakes-v1-{size}",
                f"splits.train.maps={size}",
                f"splits.valid.maps={max(4, size // 4)}",
            )
            command(
                "benchnav-datagen", "create", "stakes-v1", *changes, "--splits", "[train,valid]",
                "--out", out / f"train-{size}.h5",
            )  # fmt: skip


def train(out: Path, sizes: list[int], seeds: list[int]) -> None:
    """Trains what there is not; small sets for more epochs, so that every network takes 100 steps or more."""
    for seed in seeds:
        for size in sizes:
            place = out / checkpoint_name(size, seed)
            if (place / "config.json").exists() and "classifier" in json.loads(
                (place / "config.json").read_text()
            ).get("parts", {}):
                continue
            epochs = max(20, -(-100 // -(-size // 16)))
            command(
                "benchnav-train", "fit", "fused", "--data", out / f"train-{size}.h5", "--out", place, "--resume",
                "--seed", seed, "--settings.classifier.encoder_depth", 3, "--settings.classifier.max_epochs", epochs,
                "--settings.classifier.patience", max(10, epochs // 2),
            )  # fmt: skip


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
        path.write_text(json.dumps(found, indent=1))
    return pd.Series(found)[[dose.label for dose in models]]


def drive(out: Path, models: list[Dose], maps: int, draws: int) -> pd.DataFrame:
    """Runs the suite, or what is left of it; the rows of its episodes."""
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
        "models": [part_of(out, dose) for dose in models],
    }
    (out / "suite.yaml").write_text(yaml.safe_dump(suite))
    command("benchnav-eval", "run", "--config", out / "suite.yaml", "--out", out / "run", "--jobs", 2)
    return pd.read_parquet(out / "run" / "episodes.parquet")


def slopes_by_map(loss: np.ndarray, success: np.ndarray) -> np.ndarray:
    """Least-squares slopes of success on the loss over models, one a map.

    Args:
        loss: of each model, shape [K].
        success: share of success of each model and map, shape [K, M].

    Returns:
        Success per unit of loss, shape [M].
    """
    centred = loss - loss.mean()
    return centred @ (success - success.mean(0)) / (centred @ centred)


def report(out: Path, rows: pd.DataFrame, loss: pd.Series, models: list[Dose]) -> None:
    """Prints the test of the hypothesis, and success and time against dose; writes both to files."""
    table = rows.pivot_table(index="model", columns="map", values="success", aggfunc="mean").loc[loss.index]
    slopes = slopes_by_map(loss.to_numpy(), table.to_numpy())
    flips = sign_flips(len(slopes))
    p = float((flips @ slopes <= slopes.sum() + 1e-12).mean())
    mean, low, high = mean_interval(slopes[None])
    found = {
        "models": len(loss), "maps": len(slopes), "episodes": len(rows),
        "slope_points_per_0.001": 0.1 * float(mean[0]), "interval": [0.1 * float(low[0]), 0.1 * float(high[0])],
        "p_one_sided": p, "hypothesis_sha256": digest(),
    }  # fmt: skip
    (out / "hypothesis.json").write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1))
    lines = []
    for dose in models:
        for risk in RISKS:
            own = rows[(rows["model"] == dose.label) & (rows["risk"] == risk)]
            centre = rows[
                (rows["model"] == Dose(size=max(d.size for d in models), seed=dose.seed).label)
                & (rows["risk"] == risk)
            ]
            gain = 100 * (own.groupby("map")["success"].mean() - centre.groupby("map")["success"].mean())
            gained, least, most = mean_interval(gain.to_numpy()[None])
            lines.append(
                {"size": dose.size, "seed": dose.seed, "what": dose.what, "dose": dose.dose, "risk": risk,
                 "pinball": loss[dose.label], "success": 100 * own["success"].mean(),
                 "total_time_s": own["total_time_s"].mean(), "gain": gained[0], "least": least[0], "most": most[0]}
            )  # fmt: skip
    every = pd.DataFrame(lines)
    every.to_csv(out / "doses.csv", index=False)
    shown = every.groupby(["what", "size", "dose", "risk"]).mean(numeric_only=True).reset_index()
    printed = Table(*(str(name) for name in shown.columns if name != "seed"))
    for _, line in shown.drop(columns="seed").iterrows():
        printed.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in line))
    Console(width=160).print(printed)


def digest() -> str:
    """SHA-256 of the hypothesis."""
    return hashlib.sha256(HYPOTHESIS.read_bytes()).hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--maps", type=int, default=200)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 50, 200, 1000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    given = parser.parse_args()
    out = given.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    kept = out / "hypothesis.sha256"
    if not kept.exists():
        kept.write_text(digest())
    if kept.read_text() != digest():
        sys.exit(f"Expected the hypothesis that {out} was begun under, {kept.read_text()}, got {digest()}.")
    print(f"hypothesis {digest()}", flush=True)
    models = list(doses(given.sizes, given.seeds))
    begun = time.perf_counter()
    make_maps(out, given.sizes)
    train(out, given.sizes, given.seeds)
    loss = measure(out, models, given.maps)
    rows = drive(out, models, given.maps, given.draws)
    report(out, rows, loss, models)
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
