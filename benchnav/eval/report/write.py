"""The report of a run: findings, table, provenance and figures."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

import benchnav
from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.settings import one_line
from benchnav.core.store import write_text
from benchnav.core.tables import Table, markdown, print_table, to_latex, to_markdown
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.failures import RecordDriven, collect_sheets, failures_table
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.shipped import figures_of, is_shipped
from benchnav.eval.folder.checksums import note_checksums
from benchnav.eval.folder.provenance import command_lines
from benchnav.eval.folder.results import read_results
from benchnav.eval.folder.run_folder import ERRORS, caveats
from benchnav.eval.report.between_tables import (
    TITLE,
    between_findings,
    between_tables,
)
from benchnav.eval.report.findings import findings
from benchnav.eval.report.header import header_lines, provenance_lines
from benchnav.eval.report.hypotheses import hypothesis_findings, hypothesis_table
from benchnav.eval.report.result_tables import (
    LATENCIES,
    learning_table,
    paper_table,
    result_table,
)
from benchnav.eval.stats.best import against_best, privileged_models
from benchnav.eval.stats.between import compare_worlds
from benchnav.eval.stats.hypotheses import test_hypotheses
from benchnav.eval.stats.regret import split_regret
from benchnav.eval.stats.summary import summarise
from benchnav.eval.words import unit_of_statistics
from benchnav.planning.world.outcome import ERROR_OUTCOMES
from benchnav.viz.figure import Figure
from benchnav.viz.style import save_twice

PAGE = "report.html"
PARTIAL = "partial"  # folder of the report of an unfinished run


@dataclass(frozen=True, kw_only=True)
class Report(RunData):
    """The report of a run, with the data of the run.

    Args:
        name: name of the run.
        header: lines on the settings of the run.
        findings: sentences by title.
        table: table of results, one row per condition.
        warnings: lines on errors, and on contents that could not be shown.
        mark: mark of an unfinished run; empty for a finished run.
        faults: warnings about custom figures, which `warnings` also contains.
    """

    name: str
    header: tuple[str, ...]
    findings: Mapping[str, Sequence[str]]
    table: Table
    warnings: tuple[str, ...]
    mark: str = ""
    faults: tuple[str, ...] = ()

    @property
    def learning(self) -> Table | None:
        """The table of learning during episodes; None if no robot learnt."""
        table = learning_table(self.summary)
        return table and self.marked(table)

    @property
    def hypotheses(self) -> Table:
        """The table of the tests of hypotheses."""
        all_quantities = quantities(further_quantities(self.about))
        unit = unit_of_statistics(self.summary)
        return self.marked(hypothesis_table(self.tests, unit, all_quantities))

    @property
    def worlds(self) -> tuple[Table, ...]:
        """The tables that compare worlds; empty if the run has only one world."""
        if self.between.settings.empty:
            return ()
        unit = unit_of_statistics(self.summary)
        all_quantities = quantities(further_quantities(self.about))
        tables = between_tables(self.between, unit, all_quantities)
        return tuple(self.marked(table) for table in tables)

    def marked(self, table: Table) -> Table:
        """Return a table with a note if the run is not finished."""
        if not self.mark:
            return table
        return replace(table, notes=(_capital(self.mark), *table.notes))

    def marked_text(self, text: str) -> str:
        """Return a text, preceded by the mark if the run is not finished."""
        return f"{_capital(self.mark)}. {text}" if self.mark else text

    def csv(self, table: pd.DataFrame, digits: int = 6) -> str:
        """Return a table as CSV, with a column `partial` if the run is not finished."""
        if self.mark:
            table = table.assign(partial=self.mark.removeprefix("partial: "))
        return table.to_csv(index=False, float_format=f"%.{digits}g")


def read_report(
    folder: Path, record_driven: RecordDriven | None = None, partial: bool = False
) -> Report:
    """Create the report of a run without writing files.

    Args:
        folder: folder of a finished run.
        record_driven: function that records driven episodes again, such as
            `run.recordings.record_driven`; if None, no failure is shown on a map.
        partial: whether to accept an unfinished run, and use its finished units.

    Raises:
        ConfigError: If the folder is not a run folder, or its run is not finished.
    """
    results = read_results(folder, partial)
    manifest = results.run.manifest
    episodes = results.episodes
    worlds = {
        condition: entry["value"]["world"]
        for condition, entry in manifest["conditions"].items()
    }
    further = further_quantities(manifest)
    summary = summarise(episodes, worlds, further)
    tests = pd.DataFrame()
    if "hypotheses" in manifest:
        is_finished = not results.is_partial
        stated = manifest["hypotheses"]
        tests = test_hypotheses(
            stated, episodes, worlds, is_finished, quantities(further)
        )
    best = against_best(episodes, summary, privileged_models(manifest["conditions"]))
    summary = summary.merge(best, on="condition", how="left", validate="1:1")
    summary = summary.join(_latencies(summary, manifest["conditions"]))
    between = compare_worlds(
        results.conditions,
        episodes,
        manifest.get("hypotheses"),
        not results.is_partial,
        quantities(further),
    )
    failures = failures_table(folder, episodes)
    sheets = collect_sheets(summary, failures, record_driven)
    findings_by_title = findings(summary, failures, sheets.predicted)
    world_sentences = between_findings(between)
    if world_sentences:
        findings_by_title[TITLE] = world_sentences
    if not tests.empty:
        # Findings are exploratory if they do not test the hypotheses of the run.
        exploratory = _prefixed("Exploratory: ", findings_by_title)
        unit = unit_of_statistics(summary)
        findings_by_title = hypothesis_findings(tests, manifest, unit) | exploratory
    if results.mark:
        mark = f"{_capital(results.mark)}. "
        findings_by_title = _prefixed(mark, findings_by_title)
    warnings = [*results.notes(), *caveats(manifest)]
    manifest = {**manifest, "conditions": results.conditions}
    error_counts = summary[[f"{name}_count" for name in ERROR_OUTCOMES]]
    n_errors = error_counts.to_numpy().sum()
    if n_errors:
        episodes_in_words = "1 episode" if n_errors == 1 else f"{n_errors} episodes"
        warnings.append(
            "warning: a planner, model, sensor or belief failed in "
            f"{episodes_in_words}; see {folder / ERRORS}"
        )
    if sheets.left_out:
        warnings.append(f"note: {sheets.left_out}")
    report = Report(
        name=folder.resolve().name,
        header=header_lines(summary, episodes, manifest, worlds),
        findings=findings_by_title,
        table=result_table(summary, manifest["conditions"], further),
        warnings=tuple(warnings),
        summary=summary,
        tests=tests,
        regret=split_regret(manifest["conditions"], episodes, worlds),
        between=between,
        episodes=episodes,
        failures=failures,
        sheets=sheets,
        about=manifest,
        folder=folder,
        record_driven=record_driven,
        mark=results.mark,
    )
    return replace(report, table=report.marked(report.table))


def _latencies(
    summary: pd.DataFrame, conditions: Mapping[str, Mapping[str, Any]]
) -> pd.DataFrame:
    """Return planning times of a single robot by condition; NaN if not measured."""
    rows = [conditions[name].get("latency", {}) for name in summary["condition"]]
    table = pd.DataFrame(rows, columns=LATENCIES, dtype=float)
    return table.add_prefix("latency_")


def _prefixed(
    prefix: str, sentences_by_title: Mapping[str, list[str]]
) -> dict[str, list[str]]:
    return {prefix + title: lines for title, lines in sentences_by_title.items()}


def write_report(
    folder: Path,
    record_driven: RecordDriven | None = None,
    out: Path | None = None,
    partial: bool = False,
    figures: Sequence[Figure] = (),
) -> Report:
    """Write `report.html`, `summary.{csv,md,tex}`, `failures.csv` and `figures/`.

    Args:
        folder: folder of a finished run.
        record_driven: function that records driven episodes again, such as
            `run.recordings.record_driven`; if None, no failure is shown on a map.
        out: folder of the report; by default the run folder, or `PARTIAL` in the run
            folder for an unfinished run.
        partial: whether to accept an unfinished run.
        figures: custom figures, drawn after the shipped ones and those of the suite. A
            figure that raises is left out, and `Report.faults` has a line with the
            reason.

    Returns:
        The written report.
    """
    report = read_report(folder, record_driven, partial)
    out = out or (folder / PARTIAL if report.mark else folder)
    tables = {
        "summary": report.summary,
        "hypotheses": report.tests,
        "regret": report.regret,
        "worlds": report.between.settings,
        "worlds-agreement": report.between.agreement,
        "worlds-hypotheses": report.between.hypotheses,
    }
    texts = {
        f"{name}.csv": report.csv(table)
        for name, table in tables.items()
        if not table.empty
    }
    texts["failures.csv"] = report.csv(report.failures, digits=4)
    comment_lines = (*report.header, *report.table.notes, *report.warnings)
    comments = "".join(f"% {line}\n" for line in comment_lines)
    paper = paper_table(report.summary, report.name, report.marked_text(""))
    texts["summary.tex"] = comments + paper
    if not report.tests.empty:
        caption = report.marked_text(
            "Tests of the hypotheses that were fixed before the run."
        )
        label = f"{report.name}-hypotheses"
        texts["hypotheses.tex"] = to_latex([report.hypotheses], caption, label)
    for name, text in texts.items():
        write_text(out / name, text)
    captions, faults = _draw_figures(report, figures, out / "figures")
    report = replace(report, warnings=(*report.warnings, *faults), faults=faults)
    pages = ("summary.md", PAGE)
    for name in pages:
        write_text(out / name, render(name, report, captions))
    written = [out / name for name in (*texts, *pages)]
    for path in captions:
        written += [path, path.with_suffix(".pdf")]
    note_checksums(out, written)
    return report


def print_report(report: Report) -> None:
    """Print the tables and the findings of a report; see `print_table`."""
    if report.mark:
        print(_capital(report.mark))
    print("\n".join(report.header))
    print_table(report.table)
    if report.learning:
        print_table(report.learning)
    for table in report.worlds:
        print_table(table)
    lines = list(report.warnings)
    for title, sentences in report.findings.items():
        lines += [f"{title}:", *sentences]
    print("\n".join(lines))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _draw_figures(
    report: Report, figures: Sequence[Figure], folder: Path
) -> tuple[dict[Path, str], tuple[str, ...]]:
    """Write the figures of a run, custom figures last.

    Returns:
        Captions by path of the PNG file, and a line for each custom figure that could
        not be drawn.
    """
    captions: dict[Path, str] = {}
    _save_figures(report, figures_of(report), folder, captions)
    faults = []
    suite_figures = report.about.get("suite", {}).get("figures", ())
    for spec in (*suite_figures, *figures):
        name = getattr(spec, "name", spec)
        if isinstance(spec, Mapping):
            name = spec["part"]
        try:
            figure = registry.take("figure", spec)
            if not is_shipped(figure):
                _save_figures(report, figure.variants(report), folder, captions)
        except Exception as error:
            faults.append(f"warning: the figure {name} is missing: {one_line(error)}")
    return captions, tuple(faults)


def _save_figures(
    report: Report, figures: Iterable[Figure], folder: Path, captions: dict[Path, str]
) -> None:
    for figure in figures:
        path = folder / f"{figure.name}.png"
        if path in captions or path.parent != folder or not figure.name:
            raise ConfigError(
                "Expected a figure with a unique name that can be a file name, got "
                f"{figure.name!r}. Rename the figure."
            )
        caption = report.marked_text(figure.caption(report))
        mark = _capital(report.mark)
        save_twice(figure(report), path, trim=figure.trim, mark=mark)
        captions[path] = caption


def render(file: str, report: Report, figures: Mapping[Path, str]) -> str:
    """Return the text of a file of the report from its template.

    In HTML, all text is escaped. The page contains its figures and needs no network.

    Args:
        file: `report.html` or `summary.md`.
        report: the report.
        figures: captions by path of the PNG file.
    """
    environment = Environment(
        loader=PackageLoader("benchnav.eval.report", "templates"),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "markdown": markdown,
        "table": to_markdown,
        "inline": _inline,
        "pixels": _pixels,
    }
    return environment.get_template(file).render(
        report=report,
        figures=figures,
        provenance=provenance_lines(report.about),
        commands=command_lines(report.about),
        version=benchnav.__version__,
    )


def _inline(path: Path) -> str:
    encoded = base64.b64encode(path.read_bytes()).decode()
    return f"data:image/png;base64,{encoded}"


def _pixels(path: Path) -> int:
    """Return the width of a PNG file in pixels, from its header."""
    return int.from_bytes(path.read_bytes()[16:20])
