"""Freeze the rows of whole runs as digests, and compare runs of later code with them.

    python -m tests.golden.rows freeze --work FOLDER    # runs the suites, writes tests/golden/rows.json
    python -m tests.golden.rows check --work FOLDER     # runs them again, names each column that differs

A row is the same on one kind of machine with one version of PyTorch; `rows.json` says
which.
"""

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml

from studies.study import Study, Work

ROOT = Path(__file__).parents[2]
STORED = Path(__file__).parent / "rows.json"

# Each suite by its study and part, with what is changed in it.
SUITES: Mapping[str, tuple[str, str, dict[str, Any]]] = {
    "paper": ("results", "paper", {}),
    "risk": ("risk", "risk", {"maps": 100}),
    "knowledge": ("knowledge", "primary", {"maps": 50}),
}
DATASETS = {
    "paper-v1": ["paper-v1"],
    "stakes-v1": ["stakes-v1", "id=stakes-v1-100", "splits.test/std.maps=100"],
    "stakes-v1-400-seed2026": [
        "stakes-v1",
        "id=stakes-v1-400",
        "splits.test/std.maps=50",
        "--seed",
        "2026",
    ],
}
SPLITS = {"paper-v1": "[test/std,test/hg,test/hs]"}

# What names a row, by the headings of 1.x.
LABELS = (
    "scenario",
    "world",
    "robot",
    "objective",
    "model",
    "sensor",
    "ground",
    "belief",
    "planner",
    "risk",
)
DRAW = ["seed", "realisation", "map"]
# The same rows may have other ids and take another time.
UNCOMPARED = {
    *LABELS,
    *DRAW,
    "data",
    "condition",
    "group",
    "code",
    "learning_ms",
    "compiled",
}
# Headings of later versions by those of 1.x.
RENAMED: Mapping[str, str] = {}
# The first maps have a digest of their own, so that a short run can be compared too.
FIRST_MAPS = 2


def machine() -> dict[str, str]:
    """What the bits of a result depend on."""
    return {
        "torch": torch.__version__.partition("+")[0],
        "cpu": torch.backends.cpu.get_cpu_capability(),
    }


def digests_of(episodes: pd.DataFrame) -> dict[str, dict[str, list[str]]]:
    """Digest the columns of each condition.

    Args:
        episodes: rows of a run.

    Returns:
        By the condition's labels, by column: the digest of the first maps and that of
        all.
    """
    digests = {}
    for labels, rows in episodes.groupby(list(LABELS), sort=True):
        ordered = rows.sort_values(DRAW)
        first = ordered[ordered["map"] < FIRST_MAPS]
        columns = [
            name
            for name in ordered
            if name not in UNCOMPARED and not name.startswith("planning_")
        ]
        digests[" ".join(labels)] = {
            name: [_digest(first[name]), _digest(ordered[name])]
            for name in sorted(columns)
        }
    return digests


def differences(
    stored: Mapping[str, Mapping[str, list[str]]],
    episodes: pd.DataFrame,
    first_maps: bool = False,
) -> list[str]:
    """Name what differs from the stored digests, one line each.

    Args:
        stored: digests of a suite.
        episodes: rows of conditions of that suite.
        first_maps: whether the rows are of the first maps only, and perhaps of some
            conditions only.
    """
    computed = digests_of(episodes)
    which = 0 if first_maps else 1
    lines = [
        f"{condition}: not in the run"
        for condition in stored.keys() - computed.keys()
        if not first_maps
    ]
    lines += [
        f"{condition}: not frozen" for condition in computed.keys() - stored.keys()
    ]
    for condition in sorted(stored.keys() & computed.keys()):
        for name, digests in stored[condition].items():
            column = computed[condition].get(RENAMED.get(name, name))
            if column is None:
                lines.append(f"{condition}: no column {name}")
            elif column[which] != digests[which]:
                lines.append(f"{condition}: {name} differs")
    return lines


def run(work: Path, jobs: int) -> dict[str, pd.DataFrame]:
    """Make the datasets and run the suites, or what is missing of them."""
    maps_in = work / "maps"
    maps_in.mkdir(parents=True, exist_ok=True)
    for name, words in DATASETS.items():
        path = maps_in / f"{name}.h5"
        if not path.exists():
            splits = SPLITS.get(name, "[test/std]")
            _command(
                "benchnav-datagen",
                "create",
                *words,
                "--splits",
                splits,
                "--out",
                str(path),
            )
    tables = {}
    for name, (study, part, changes) in SUITES.items():
        suite = Study.load(study).suite(part, Work(out=work, maps_in=maps_in)) | changes
        suite["data"] = str(maps_in / f"{Path(suite['data']).stem}.h5")
        # Hypotheses do not bear on rows.
        suite.pop("hypotheses", None)
        config = work / f"{name}.yaml"
        config.write_text(yaml.safe_dump(suite, sort_keys=False, allow_unicode=True))
        folder = work / name
        _command(
            "benchnav-eval",
            "run",
            "--config",
            str(config),
            "--out",
            str(folder),
            "--jobs",
            str(jobs),
        )
        tables[name] = pd.read_parquet(folder / "episodes.parquet")
    return tables


def _command(program: str, *words: str) -> None:
    path = Path(sys.executable).with_name(program)
    if code := subprocess.run([path, *words], cwd=ROOT).returncode:
        sys.exit(code)


def _digest(values: pd.Series) -> str:
    """Digest a column by the bits of its numbers, or by its text."""
    if pd.api.types.is_numeric_dtype(values) or pd.api.types.is_bool_dtype(values):
        numbers = values.to_numpy(dtype=np.float64, na_value=np.nan)
        content = np.where(np.isnan(numbers), np.nan, numbers).tobytes()
    else:
        content = "\0".join(values.fillna("").astype(str)).encode()
    return hashlib.sha256(content).hexdigest()[:16]


def main() -> None:
    """Freeze or check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["freeze", "check"])
    parser.add_argument(
        "--work", type=Path, required=True, help="folder of the maps and runs"
    )
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    tables = run(given.work.resolve(), given.jobs)
    if given.what == "freeze":
        suites = {name: digests_of(episodes) for name, episodes in tables.items()}
        STORED.write_text(
            json.dumps(
                {"machine": machine(), "suites": suites}, indent=1, ensure_ascii=False
            )
            + "\n"
        )
        print(f"wrote {STORED}")
        return
    stored = json.loads(STORED.read_text())
    if stored["machine"] != machine():
        print(
            f"frozen on {stored['machine']}, compared on {machine()}: bits may differ only for that reason"
        )
    lines = [
        f"{name}: {line}"
        for name, episodes in tables.items()
        for line in differences(stored["suites"][name], episodes)
    ]
    print("\n".join(lines) or "all digests are equal")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
