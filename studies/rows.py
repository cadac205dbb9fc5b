"""Rows of finished runs, stored in the folder of a study.

Each run has a table of conditions and one of episodes. Their format does not depend on
the version of the run folder, so every later version can read them.
"""

from pathlib import Path

import pandas as pd

from studies.study import Study, Work

SUMMARY, EPISODES = "summary.csv", "episodes.parquet"
KEPT = (
    "data",
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
    "seed",
    "realisation",
    "map",
    "group",
    "outcome",
    "success",
    "total_time_s",
    "end_time_s",
    "traversability",
    "reference_time_s",
)


def folder_of(study: Study, run: str, work: Work) -> Path:
    """Return the folder of a run, or that of its stored rows if the run is missing."""
    folder = work.out / run
    return folder if folder.exists() else study.folder / "rows" / run


def keep(study: Study, parts: list[str], work: Work) -> None:
    """Store the rows of these parts' finished runs in the study's folder."""
    for part in parts:
        run = study.run_of(part)
        folder, stored = work.out / run, study.folder / "rows" / run
        if not (folder / EPISODES).exists():
            print(f"not finished: {run}")
            continue
        stored.mkdir(parents=True, exist_ok=True)
        summary = pd.read_csv(folder / SUMMARY, dtype=str, keep_default_na=False)
        _without_paths(summary).to_csv(stored / SUMMARY, index=False)
        episodes = _without_paths(
            pd.read_parquet(folder / EPISODES, columns=list(KEPT))
        )
        episodes.to_parquet(
            stored / EPISODES, index=False, compression="zstd", compression_level=19
        )
        print(f"kept: {run}, {len(summary)} conditions, {len(episodes)} episodes")


def _without_paths(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose datasets are file names without folders."""
    return table.assign(data=[Path(data).name for data in table["data"]])
