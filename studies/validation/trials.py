"""The experiment of Cai et al. with our planner and risk settings.

What is theirs, what is ours and what differs stands in `docs/studies/validation.md`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.progress import show_progress
from benchnav.core.settings import of, read
from benchnav.core.store import write_text
from studies.study import Work
from studies.validation.run import SETTINGS, run_trials
from studies.validation.tables import tabulate, tabulate_runs
from studies.validation.task import Setup, planner_config

DENSITIES = (0.1, 0.4, 0.7, 1.0)


def trials(
    work: Work, folder: Path, risks: Sequence[str] = SETTINGS, densities: Sequence[float] = DENSITIES, maps: int = 40,
    realisations: int = 5, seed: int = 0, **setup: Any,
) -> dict[str, str]:  # fmt: skip
    """Run trials, store them as trials.csv, and return their tables.

    Args:
        work: of the study; not used.
        folder: of the run.
        risks: risk settings.
        densities: of vegetation.
        maps: number of maps.
        realisations: draws of traction a map.
        seed: root of all draws.
        **setup: fields of `Setup`.
    """
    settings: Setup = read(Setup, setup, of("the options"))
    rows: list[pd.DataFrame] = []
    units = run_trials(densities, risks, maps, realisations, seed, settings)
    total = maps * realisations * len({planner_config(risk, settings) for risk in risks})
    show_progress(((len(rows), total) for unit in units if rows.append(unit) is None), "trials a planner")
    made = in_order(pd.concat(rows, ignore_index=True), densities, risks)
    write_text(folder / "trials.csv", made.to_csv(index=False))
    return {"trials": tabulate(made)}


def in_order(rows: pd.DataFrame, densities: Sequence[float], risks: Sequence[str]) -> pd.DataFrame:
    """Return rows by density and setting in the given order, then by map and realisation."""
    rank = {"density": list(densities).index, "setting": list(risks).index}
    return rows.sort_values(
        ["density", "setting", "map", "realisation"],
        key=lambda column: column.map(rank[column.name]) if column.name in rank else column,
        ignore_index=True,
    )


def together(work: Work, folder: Path, parts: Sequence[str]) -> dict[str, str]:
    """Return the tables of the trials of several parts."""
    return {"trials": tabulate(pd.concat(_read(work, part) for part in parts))}


def compared(work: Work, folder: Path, runs: dict[str, str]) -> dict[str, str]:
    """Return the table of several parts by a name each, and what each changes on the first."""
    return {"runs": tabulate_runs({name: _read(work, part) for name, part in runs.items()})}


def _read(work: Work, part: str) -> pd.DataFrame:
    return pd.read_csv(work.out / f"validation-{part}" / "trials.csv")
