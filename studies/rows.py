"""Rows of finished runs that a study keeps in its folder: a table of conditions and one
of episodes for each run.

They are stored apart from any version of the run folder, so that every later version
can read them.
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
    """Return the folder of a run, or of the rows that are kept of it where it is not
    there.
    """
    folder = work.out / run
    return folder if folder.exists() else study.folder / "rows" / run


def keep(study: Study, parts: list[str], work: Work) -> None:
    """Store rows of the finished runs of these parts in the study's folder."""
    for part in parts:
        run = study.run_of(part)
        folder, kept = work.out / run, study.folder / "rows" / run
        if not (folder / EPISODES).exists():
            print(f"not finished: {run}")
            continue
        kept.mkdir(parents=True, exist_ok=True)
        summary = pd.read_csv(folder / SUMMARY, dtype=str, keep_default_na=False)
        _without_paths(summary).to_csv(kept / SUMMARY, index=False)
        episodes = _without_paths(
            pd.read_parquet(folder / EPISODES, columns=list(KEPT))
        )
        episodes.to_parquet(
            kept / EPISODES, index=False, compression="zstd", compression_level=19
        )
        print(f"kept: {run}, {len(summary)} conditions, {len(episodes)} episodes")


def _without_paths(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table that names maps by their file alone."""
    return table.assign(data=[Path(data).name for data in table["data"]])
