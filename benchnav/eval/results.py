"""Results of a run as an object: episodes, tables, comparisons, figures, report."""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure as Drawing

from benchnav.core.errors import ConfigError, expect
from benchnav.core.settings import hint
from benchnav.core.tables import Table, to_markdown, to_terminal
from benchnav.eval.between import Between, between_results
from benchnav.eval.compare import compare_runs, write_comparison
from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.figures.shipped import figures_of
from benchnav.eval.folder import results as rows
from benchnav.eval.folder.run_folder import caveats, is_taken, open_run
from benchnav.eval.report.playback.viewer_file import write_viewer_files
from benchnav.eval.report.write import PAGE, Report, read_report, write_report
from benchnav.eval.run.recordings import record_driven
from benchnav.viz.figure import Figure


@dataclass(frozen=True, eq=False)
class Comparison:
    """Paired differences of conditions.

    Args:
        numbers: one row per pair, with the columns of the CSV file of `compare`.
        table: formatted table, with notes.
    """

    numbers: pd.DataFrame
    table: Table

    def save(self, stem: str | Path) -> list[Path]:
        """Write STEM.csv, STEM.md and STEM.tex; return their paths."""
        return write_comparison(Path(stem), self.numbers, self.table)

    def __repr__(self) -> str:
        """Return one line with the number of pairs."""
        return (
            f"Comparison of {len(self.numbers)} pairs; .numbers is a DataFrame, "
            "print() shows the table"
        )

    def __str__(self) -> str:
        """Return the table as text."""
        return to_terminal(self.table)

    def _repr_markdown_(self) -> str:
        return to_markdown(self.table)


class Results:
    """The results of a run.

    Args:
        folder: a run folder.
        temporary: temporary folder that contains `folder` and is deleted together with
            this object.
    """

    def __init__(
        self,
        folder: str | Path,
        temporary: tempfile.TemporaryDirectory[str] | None = None,
    ) -> None:
        """Open a run folder.

        Raises:
            ConfigError: If the folder is no run folder, or has no finished unit.
        """
        self.folder = Path(folder)
        self._temporary = temporary
        self._rows = rows.read_results(self.folder, partial=True)

    @property
    def episodes(self) -> pd.DataFrame:
        """One row per episode: labels, seed, realisation, map, and all metrics."""
        return self._rows.episodes.copy()

    @property
    def conditions(self) -> pd.DataFrame:
        """One row per condition, by id: the labels of its parts."""
        entries = self._rows.conditions
        labels = [entry["labels"] for entry in entries.values()]
        return pd.DataFrame(
            labels, index=pd.Index(entries, name="condition"), columns=list(LABELS)
        )

    @property
    def notes(self) -> list[str]:
        """Warnings, and combinations that were left out."""
        return [*self._rows.notes(), *caveats(self._rows.run.manifest)]

    @property
    def summary(self) -> pd.DataFrame:
        """One row per condition: rates, means, intervals, comparison with the best."""
        return self._report.summary.copy()

    @property
    def hypotheses(self) -> pd.DataFrame:
        """One row per hypothesis: claim, difference with interval, p and verdict.

        Empty if the run has no hypotheses.
        """
        return self._report.tests.copy()

    def best(self) -> pd.DataFrame:
        """Return the conditions that are not significantly worse than their block's best.

        Conditions are ordered by success rate. The test is a max-T bootstrap test over
        maps; see docs/concepts/statistics.md. If no condition of a block is
        significantly worse, all conditions of the block that compete are returned.
        """
        summary = self._report.summary
        competing = summary[summary["best_alike"].astype(bool)]
        columns = [
            *LABELS,
            "success_rate",
            "success_low",
            "success_high",
            "total_time_mean_s",
            "best_p",
        ]
        ordered = competing.sort_values("success_rate", ascending=False, kind="stable")
        return ordered[columns].reset_index(drop=True)

    def compare(
        self,
        by: str = "",
        against: str = "",
        points: float = 5.0,
        **labels: str | Sequence[str],
    ) -> Comparison:
        """Compare conditions evaluated on the same maps with the same draws of λ.

        Args:
            by: column in which the conditions of a pair differ, such as "risk"; if
                empty, the column of `against`, or "risk" without `against`.
            against: label with which all other conditions are compared; if empty, all
                pairs are compared.
            points: difference in success rate, in percentage points. The table states
                the number of maps that is required to detect it.
            **labels: labels of the compared conditions, one or several for each column,
                such as planner="mppi".

        Raises:
            ConfigError: If there is nothing to compare, or conditions cannot be paired.
        """
        numbers, table = compare_runs(
            [self.folder], by, against, _selected(labels), points / 100
        )
        return Comparison(numbers, table)

    def between(self, **labels: str | Sequence[str]) -> Between:
        """Compare the results of the same settings in several worlds.

        A setting is a condition without its world. The episodes that it has in all
        worlds are compared; see docs/how-to/compare-conditions.md.

        Args:
            **labels: labels of the compared conditions, one or several for each column,
                such as planner="mppi".

        Raises:
            ConfigError: If no setting was run in two worlds.
        """
        return between_results(self._rows, _selected(labels))

    @property
    def plot(self) -> "Plots":
        """Figures of the report, as methods that return matplotlib figures; see `Plots`."""
        return Plots(self)

    def report(
        self, folder: str | Path | None = None, figures: Sequence[Figure] = ()
    ) -> Path:
        """Write the report (page, tables, figures), and return the path of its page.

        Args:
            folder: folder of the report; if None, the run folder.
            figures: custom figures, after the shipped ones. A figure that raises is
                left out, and the page states the reason.
        """
        out = Path(folder) if folder else self.folder
        if out == self.folder and not self._rows.is_partial:
            write_viewer_files(self.folder)
        write_report(
            self.folder,
            partial(record_driven, self.folder),
            out,
            self._rows.is_partial,
            figures,
        )
        return out / PAGE

    def save(self, folder: str | Path) -> "Results":
        """Copy the run to a folder, and return the results there.

        Raises:
            ConfigError: If the folder is not empty.
        """
        target = Path(folder)
        if is_taken(target):
            raise ConfigError(
                f"Expected `folder` to be new or empty, got {target}, which is neither."
                " Choose another folder."
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            dir=target.parent, prefix=f".{target.name}-"
        ) as copied:
            copy = Path(copied, "run")
            shutil.copytree(self.folder, copy)
            copy.replace(target)
        return Results(target)

    @cached_property
    def _report(self) -> Report:
        return read_report(self.folder, partial=self._rows.is_partial)

    def __repr__(self) -> str:
        """Return lines with size, success rate, folder and the main attributes."""
        n_conditions = len(self._rows.conditions)
        n_maps = self._rows.episodes["map"].nunique()
        rate = 100 * self._rows.episodes["success"].mean()
        lines = [
            f"Results of {len(self._rows.episodes)} episodes: {n_conditions} "
            f"conditions on {n_maps} maps",
            f"success {rate:.1f} % over all; folder {self.folder}",
            *([self._rows.mark] if self._rows.mark else []),
            ".episodes .summary .conditions .notes; .best() .compare(by=…) "
            ".between() .plot.… .report() .save(folder)",
        ]
        return "\n".join(lines)

    def _repr_markdown_(self) -> str:
        return to_markdown(self._report.table)


class Plots:
    """Figures of a run as methods, with the names of their files and `_` for `-`.

    Calling this object with a figure draws that figure. A figure with several variants,
    such as `over`, is drawn as a list of all variants.
    """

    def __init__(self, results: Results) -> None:
        """Draw from results."""
        self._results = results

    def __call__(self, figure: Figure) -> Drawing | list[Drawing]:
        """Draw a custom figure; return a list if it has several variants.

        Raises:
            ConfigError: If the run lacks data that the figure needs.
        """
        variants = figure.variants(self._results._report)
        if not variants:
            raise ConfigError(
                f"Expected a run with the data that figure {figure.name!r} needs, got "
                f"{self._results.folder} without these data."
            )
        return self._draw_all(variants)

    def __dir__(self) -> list[str]:
        """List the figures of the run."""
        return sorted(self._figures)

    @cached_property
    def _figures(self) -> dict[str, Figure]:
        figures = figures_of(self._results._report)
        return {figure.name.replace("-", "_"): figure for figure in figures}

    def __getattr__(self, name: str) -> Any:
        """Return the function that draws a figure."""
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._draw, name)

    def _draw(self, name: str) -> Drawing | list[Drawing]:
        """Draw the figure with this name, or all variants of the figure."""
        figures = self._figures
        matching = []
        for figure_name, figure in figures.items():
            class_name = type(figure).name.replace("-", "_")
            if name in (figure_name, class_name):
                matching.append(figure)
        if not matching:
            raise ConfigError(
                f"Expected a figure of the run ({', '.join(figures)}), got "
                f"{name!r}.{hint(name, figures)}"
            )
        return self._draw_all(matching)

    def _draw_all(self, figures: Sequence[Figure]) -> Drawing | list[Drawing]:
        drawings = [figure(self._results._report) for figure in figures]
        return drawings[0] if len(drawings) == 1 else drawings


def _selected(labels: Mapping[str, str | Sequence[str]]) -> dict[str, list[str]]:
    """Return lists of labels by column.

    Raises:
        ConfigError: If a column does not exist.
    """
    selected = {}
    for name, value in labels.items():
        expect(name in LABELS, f"labels among {', '.join(LABELS)}, got {name!r}.")
        selected[name] = [value] if isinstance(value, str) else list(value)
    return selected


def open_results(folder: str | Path) -> Results:
    """Open the results of a run folder, finished or not; see `evaluate`.

    Raises:
        ConfigError: If the folder is no run folder, or has no finished unit.
    """
    open_run(Path(folder))
    return Results(folder)
