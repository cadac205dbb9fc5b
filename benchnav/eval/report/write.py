"""The report of a run: what it says, its table, where its rows come from, and its figures."""

import base64
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

import benchnav
from benchnav.core.errors import BenchnavError
from benchnav.core.figures import planner_name, save_twice
from benchnav.core.store import write_text
from benchnav.core.tables import Table, markdown, print_table, to_latex, to_markdown
from benchnav.eval.experiment.condition import KNOWLEDGE
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.folder.checksums import note_checksums
from benchnav.eval.folder.provenance import METRICS, command_lines
from benchnav.eval.folder.results import read_results
from benchnav.eval.folder.run_folder import ERRORS, caveats
from benchnav.eval.recording import MAP, Ground, Recording, read_recordings
from benchnav.eval.report.charts.conditions import (
    distribution_figure,
    forest_figure,
    outcome_figure,
    success_figure,
)
from benchnav.eval.report.charts.knowledge import draw_knowledge
from benchnav.eval.report.charts.maps import (
    MOST_PANELS,
    choose_recordings,
    driven_figure,
    failure_figure,
    read_driven,
    trajectory_figure,
)
from benchnav.eval.report.charts.regret import MOST_CHAINS, regret_figure
from benchnav.eval.report.charts.sweeps import curve_figure, find_sweeps, sweep_name
from benchnav.eval.report.failures import RecordDriven, Sheets, collect_sheets, failures_table
from benchnav.eval.report.findings import findings
from benchnav.eval.report.hypotheses import hypothesis_findings, hypothesis_table
from benchnav.eval.report.result_tables import LATENCIES, learning_table, paper_table, result_table
from benchnav.eval.report.words import NOT_USED, joined, maps_in_words, unit_of_statistics
from benchnav.eval.stats.best import against_best, privileged_models
from benchnav.eval.stats.hypotheses import test_hypotheses
from benchnav.eval.stats.regret import best_possible, split_regret
from benchnav.eval.stats.summary import summarise, time_budgets
from benchnav.planning.world.outcome import ERROR_OUTCOMES

PAGE = "report.html"
PARTIAL = "partial"  # folder of the report of a run that is not finished

_FILES = (PAGE, *(f"summary.{suffix}" for suffix in ("csv", "md", "tex")), "failures.csv", "hypotheses.csv")
_FILES += ("hypotheses.tex", "regret.csv")
_MOST_PATHS = 8
_EPISODE = ("condition", "seed", "realisation", "map")


@dataclass(frozen=True, kw_only=True)
class Report:
    """What is reported of a run.

    Args:
        name: of the run.
        header: lines on where the rows come from.
        findings: what the run says, sentences by the title over them.
        table: a row a condition.
        warnings: lines on what went wrong, or could not be shown.
        summary: the numbers behind the table.
        tests: a row a hypothesis, from `hypotheses.test_hypotheses`; none where the suite held none.
        regret: from `regret.split_regret`; none where the run has no chain.
        episodes: the rows behind the summary.
        failures: a row a failed episode.
        sheets: failures on their ground.
        about: all of `run.json`; of a run that is not finished with the conditions that have rows.
        mark: what says that the run is not finished; empty where it is.
    """

    name: str
    header: tuple[str, ...]
    findings: Mapping[str, Sequence[str]]
    table: Table
    warnings: tuple[str, ...]
    summary: pd.DataFrame
    tests: pd.DataFrame
    regret: pd.DataFrame
    episodes: pd.DataFrame
    failures: pd.DataFrame
    sheets: Sheets
    about: Mapping[str, Any]
    mark: str = ""

    @property
    def learning(self) -> Table | None:
        """What robots learnt on their way; None where none learnt."""
        table = learning_table(self.summary)
        return table and self.marked(table)

    @property
    def hypotheses(self) -> Table:
        """The table of `tests`."""
        known = quantities(further_quantities(self.about))
        return self.marked(hypothesis_table(self.tests, unit_of_statistics(self.summary), known))

    def marked(self, table: Table) -> Table:
        """A table that says so where the run is not finished."""
        return replace(table, notes=(*([_capital(self.mark)] if self.mark else []), *table.notes))

    def csv(self, table: pd.DataFrame, digits: int = 6) -> str:
        """A table as CSV; of a run that is not finished it has a column `partial`."""
        marked = table.assign(partial=self.mark.removeprefix("partial: ")) if self.mark else table
        return marked.to_csv(index=False, float_format=f"%.{digits}g")


def read_report(folder: Path, record_driven: RecordDriven | None = None, partial: bool = False) -> Report:
    """Makes the report of a run, and writes nothing.

    Args:
        folder: a finished run.
        record_driven: records driven episodes again, as `run.recordings.record_driven` does of the folder; without it
            no failure is shown on a map.
        partial: also of a run that is not finished, of what is there.

    Raises:
        ConfigError: the folder is no run folder, or its run is not finished.
    """
    results = read_results(folder, partial)
    about, episodes = results.run.about, results.episodes
    worlds = {condition: entry["value"]["world"] for condition, entry in about["conditions"].items()}
    further = further_quantities(about)
    summary = summarise(episodes, worlds, further)
    tests = (
        test_hypotheses(about["hypotheses"], episodes, worlds, not results.is_partial, quantities(further))
        if "hypotheses" in about
        else pd.DataFrame()
    )
    best = against_best(episodes, summary, privileged_models(about["conditions"]))
    summary = summary.merge(best, on="condition", how="left", validate="1:1")
    # How long a step of one robot takes, where the run measured it.
    known = [about["conditions"][condition].get("latency", {}) for condition in summary["condition"]]
    summary = summary.join(pd.DataFrame(known, columns=LATENCIES, dtype=float).add_prefix("latency_"))
    failures = failures_table(folder, episodes)
    sheets = collect_sheets(summary, failures, record_driven)
    said = findings(summary, failures, sheets.predicted)
    if not tests.empty:
        # Beside hypotheses that were fixed before the run all else is exploratory.
        explored = {f"Exploratory: {title}": sentences for title, sentences in said.items()}
        said = hypothesis_findings(tests, about, unit_of_statistics(summary)) | explored
    if results.mark:
        said = {f"{_capital(results.mark)}. {title}": sentences for title, sentences in said.items()}
    warnings = [*results.notes(), *caveats(about)]
    about = {**about, "conditions": results.conditions}
    if count := summary[[f"{name}_count" for name in ERROR_OUTCOMES]].to_numpy().sum():
        episodes_in_words = "1 episode" if count == 1 else f"{count} episodes"
        warnings.append(
            f"warning: a planner, model, sensor or belief failed in {episodes_in_words}; see {folder / ERRORS}"
        )
    if sheets.left_out:
        warnings.append(f"note: {sheets.left_out}")
    report = Report(
        name=folder.resolve().name,
        header=(
            *_header(summary, about),
            *_rejected_draws(episodes, about["conditions"]),
            *_bracket(episodes, about["conditions"], worlds),
        ),
        findings=said,
        table=result_table(summary, about["conditions"], further),
        warnings=tuple(warnings),
        summary=summary,
        tests=tests,
        regret=split_regret(about["conditions"], episodes, worlds),
        episodes=episodes,
        failures=failures,
        sheets=sheets,
        about=about,
        mark=results.mark,
    )
    return replace(report, table=report.marked(report.table))


def write_report(
    folder: Path,
    record_driven: RecordDriven | None = None,
    out: Path | None = None,
    partial: bool = False,
) -> Report:
    """Writes `report.html`, `summary.{csv,md,tex}`, `failures.csv` and `figures/` of a run.

    Args:
        folder: a finished run.
        record_driven: records driven episodes again, as `run.recordings.record_driven` does of the folder; without it
            no failure is shown on a map.
        out: where to. If not given, the run folder, and its folder `PARTIAL` for a run that is not finished.
        partial: also of a run that is not finished, of what is there.

    Returns:
        What was written of.
    """
    report = read_report(folder, record_driven, partial)
    out = out or (folder / PARTIAL if report.mark else folder)
    write_text(out / "summary.csv", report.csv(report.summary))
    write_text(out / "failures.csv", report.csv(report.failures, digits=4))
    comments = "".join(f"% {line}\n" for line in (*report.header, *report.table.notes, *report.warnings))
    mark = f"{_capital(report.mark)}. " if report.mark else ""
    write_text(out / "summary.tex", comments + paper_table(report.summary, report.name, mark))
    if not report.tests.empty:
        write_text(out / "hypotheses.csv", report.csv(report.tests))
        caption = f"{mark}Tests of the hypotheses that were fixed before the run."
        write_text(
            out / "hypotheses.tex", to_latex([report.hypotheses], caption, f"{report.name}-hypotheses")
        )
    if not report.regret.empty:
        write_text(out / "regret.csv", report.csv(report.regret))
    figures = {}
    for name, caption, figure in run_figures(folder, report, record_driven):
        path = out / "figures" / f"{name}.png"
        # These are as wide as their maps: white borders are cut away.
        is_of_maps = name.partition("-")[0] in ("trajectories", "driven", "knowledge")
        save_twice(figure, path, trim=is_of_maps, mark=_capital(report.mark))
        figures[path] = mark + caption
    for file in ("summary.md", PAGE):
        write_text(out / file, render(file, report, figures))
    drawn = [path.with_suffix(suffix) for path in figures for suffix in (".png", ".pdf")]
    note_checksums(out, [*drawn, *(path for name in _FILES if (path := out / name).is_file())])
    return report


def print_report(report: Report) -> None:
    """Prints what a run says and its table, as wide as the terminal, or unbroken where none is."""
    print("\n".join([*([_capital(report.mark)] if report.mark else []), *report.header]))
    print_table(report.table)
    if report.learning:
        print_table(report.learning)
    said = [line for title, lines in report.findings.items() for line in (f"{title}:", *lines)]
    print("\n".join([*report.warnings, *said]))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def run_figures(
    folder: Path, report: Report, record_driven: RecordDriven | None
) -> Iterator[tuple[str, str, Figure]]:
    """Gives name, caption and figure of all that is drawn of a run.

    First is what it was to show, how often, and on which map it is seen best.
    """
    summary, sheets = report.summary, report.sheets.shown
    if not report.tests.empty:
        yield (
            "forest",
            "Paired differences of the hypotheses that were fixed before the run. Filled points are supported "
            "(p < 0.05 after Holm's correction). Lines are 90 % (thick) and 95 % (thin) intervals of one difference.",
            forest_figure(report.tests, quantities(further_quantities(report.about))),
        )
    yield (
        "success",
        "Success rates with 95 % intervals. Filled points are not significantly worse than the best of their panel; "
        "all are open where nothing is significantly worse. Grey planners are blind.",
        success_figure(summary),
    )
    if not report.regret.empty:
        chains = report.regret["chain"].nunique()
        shown = f" The first {MOST_CHAINS} of {chains} chains are shown." if chains > MOST_CHAINS else ""
        yield (
            "regret",
            "Regret against the near-optimal reference, a drive on λ itself and no bound: step by step from a planner "
            "to it, on the episodes that all have in common, paired differences with 95 % intervals. A step may be "
            "negative, and in another order steps would be others, so that none is "
            f"a share of the causes.{shown}",
            regret_figure(report.regret),
        )
    driven = read_driven(folder, report.episodes)
    if driven is not None:
        yield _driven(*driven)
    sweeps = find_sweeps(report.about["conditions"])
    names = Counter(map(sweep_name, sweeps))
    for number, lines in sweeps.items():
        short = sweep_name(number)
        name = short if names[short] == 1 else number.replace(".", "-")
        caption = f"Success and T_total over {name}, with 95 % intervals."
        yield f"over-{name}", caption, curve_figure(number, lines, summary)
    yield "outcomes", "Outcomes of the episodes.", outcome_figure(summary)
    yield (
        "distributions",
        "Each dot is an episode. Left: T_total, a failure counted as T. Right: λ̄, the mean observed λ.",
        distribution_figure(summary, report.episodes),
    )
    for place, (title, sheet) in enumerate(sheets, start=1):
        yield (
            "failures" if len(sheets) == 1 else f"failures-{place}",
            f"Failures of the settings with the highest and the lowest success rate, {title}: predicted λ̂ (colour), "
            "driven path and its end. λ̂ is that of the cell of the end, observed λ the mean of the last 2 s.",
            failure_figure(sheet),
        )
    recorded = read_recordings(folder)
    yield from draw_knowledge(folder, report.episodes, summary, recorded)
    if driven and (chosen := _on_one_map(driven[1], recorded, record_driven)):
        caption = _trajectories_in_words(chosen) + _chosen_in_words(len(chosen), len(driven[1]))
        yield "trajectories", caption, trajectory_figure(chosen)
    elif chosen := choose_recordings(recorded, list(summary["condition"])):
        yield "trajectories", _trajectories_in_words(chosen), trajectory_figure(chosen)


def _trajectories_in_words(chosen: Sequence[Recording]) -> str:
    """Says what `trajectory_figure` shows."""
    maps = {(own.about["scenario"], own.about["map"]) for own in chosen}
    where = " on {}, map {}".format(*maps.pop()) if len(maps) == 1 else ""
    what = "Plans and driven paths" if any(own.own_plans for own in chosen) else "Driven paths"
    caption = f"{what}{where}, over the terrain and over the λ̂ that the planner was given."
    if any(own.field is not None for own in chosen):
        caption += " Below: the whole driven path over the λ field."
    return caption


def _on_one_map(
    rows: pd.DataFrame, recorded: Sequence[Recording], record_driven: RecordDriven | None
) -> list[Recording]:
    """Recordings of a few conditions on the map on which outcomes differ most, as many that arrived as not.

    Args:
        rows: an episode a condition on that map.
        recorded: all there are, which tell what was planned too; the others are made of the steps that were kept.
        record_driven: makes those.

    Returns:
        At most `MOST_PANELS`, in the order of the rows; none where one cannot be made.
    """
    chosen = rows.iloc[_evenly(rows, MOST_PANELS)]
    known = {tuple(str(own.about[name]) for name in _EPISODE): own for own in recorded}
    found = []
    for place, row in chosen.iterrows():
        own = known.get(tuple(str(row[name]) for name in _EPISODE))
        if own is None and record_driven is not None:
            try:
                (own,) = record_driven(chosen.loc[[place]])
            except (BenchnavError, OSError):
                return []
        if own is None:
            return []
        found.append(own)
    return found


def _evenly(rows: pd.DataFrame, most: int) -> list[int]:
    """Places of at most so many episodes in the order of the rows, as many that arrived as not where there are such."""
    turn = rows.groupby("success", sort=False).cumcount().to_numpy()
    return sorted(np.argsort(turn, kind="stable")[:most].tolist())


def _driven(ground: Ground, rows: pd.DataFrame, tracks: Sequence[np.ndarray]) -> tuple[str, str, Figure]:
    """The figure of whole driven paths, as from `read_driven`."""
    about, places = ground.about, _evenly(rows, _MOST_PATHS)
    shown = rows.iloc[places]
    why = (
        "On this map outcomes differ most." if rows["success"].nunique() > 1 else "Outcomes differ on no map."
    )
    caption = (
        f"Driven paths on {about['scenario']}, map {about['map']}, seed {about['seed']}, realisation "
        f"{about['realisation']}. {why}"
    )
    caption += _chosen_in_words(len(shown), len(rows))
    return "driven", caption, driven_figure(ground, shown, [tracks[place] for place in places])


def _chosen_in_words(shown: int, known: int) -> str:
    """Says how conditions were chosen by `_evenly`, where not all are shown."""
    words = f" Shown are {shown} of {known} conditions, as many that arrived as not where there are such."
    return words if shown < known else ""


def _header(summary: pd.DataFrame, about: Mapping[str, Any]) -> list[str]:
    conditions = [about["conditions"][condition] for condition in summary["condition"]]
    worlds = {condition["labels"]["world"]: _world(condition["value"]) for condition in conditions}
    lines = [f"World {label}: {text}." for label, text in worlds.items()]
    seeds = dict.fromkeys(seed for condition in conditions for seed in condition["seeds"])
    data, models = (joined(summary[name].unique()) or NOT_USED for name in ("data", "model"))
    lines.append(f"Data: {data}. Models: {models}. Seeds: {joined(map(str, seeds))}.")
    if summary["revisions_mean"].notna().any():
        known = (f"{kind} {joined(summary[kind].unique()) or NOT_USED}" for kind in KNOWLEDGE)
        lines.append(f"What robots know by: {'; '.join(known)}.")
    if len(summary[["n_episodes", "n_maps", "n_groups"]].drop_duplicates()) == 1:
        maps = maps_in_words(summary["n_maps"][0], summary["n_groups"][0])
        lines.append(f"Each condition: {summary['n_episodes'][0]} episodes on {maps}.")
    options = dict.fromkeys(
        f"{condition['labels']['planner']} {change}"
        for condition in conditions
        for change in condition["changed"]
    )
    return [*lines, f"Planner options: {', '.join(options)}."] if options else lines


def _rejected_draws(episodes: pd.DataFrame, conditions: Mapping[str, Any]) -> list[str]:
    """The share of draws of frozen λ that were rejected."""
    frozen = [name for name, about in conditions.items() if about["value"]["world"]["noise"] == "frozen"]
    episodes = episodes[episodes["condition"].isin(frozen)]
    if not episodes["rejected_draws"].any():
        return []
    # All conditions met the same; where a model failed nothing was drawn.
    again = episodes.groupby(MAP)["rejected_draws"].max()
    share = again.sum() / (again + 1).sum()
    return [
        f"{100 * share:.1f} % of the draws of λ had no feasible path from start to goal and were rejected."
    ]


def _bracket(
    episodes: pd.DataFrame, conditions: Mapping[str, Any], worlds: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Both ends between which the least time lies, of each condition whose planner is given λ."""
    found = []
    for name, rows in episodes.groupby("condition", sort=False):
        rows = rows.assign(time_budget_s=time_budgets(rows, worlds[str(name)]))
        best = best_possible(rows)
        if np.isnan(best["time_bound"]):
            continue
        reached, time_s = rows["success"].mean(), rows["total_time_s"].mean()
        labels = conditions[str(name)]["labels"]
        found.append(
            f"The best that any planner can do ({labels['scenario']}, {labels['world']}) lies between a lower bound "
            f"and what {planner_name(labels['planner'])} drives: T_total {best['time_bound']:.1f} to {time_s:.1f} s, "
            f"success {100 * reached:.1f} to {100 * best['success_bound']:.1f} %."
        )
    return found


def _world(value: Mapping[str, Any]) -> str:
    world, free = value["world"], value["rules"]["free_space"]
    words = [f"λ {world['noise']}"]
    if "correlation_m" in world:
        words[0] += f", correlated over {world['correlation_m']:g} m"
        words[0] += " (Matérn-3/2)" if world.get("kernel") == "matern32" else ""
    if "immobile" in world:
        held = world["immobile"]
        words.append(f"λ below {held['below']:g} for {held['for_s']:g} s immobilises the robot")
    if "time_budget_ratio" in world:
        words.append(f"time budget T = {world['time_budget_ratio']:g} × the reference time at the top speed")
    else:
        words.append(f"time budget T = {world['time_budget_s']:g} s")
    by = "mean λ" if free["by"] == "mean" else "λ̂"
    return "; ".join([*words, f"free ground has {by} above {free['above']:g}"])


def render(file: str, report: Report, figures: Mapping[Path, str]) -> str:
    """Fills the template of a file; in HTML all text is escaped, and the page needs no other file and no network.

    Args:
        file: `report.html` or `summary.md`.
        report: what is said.
        figures: by the path of its PNG what each shows.
    """
    environment = Environment(
        loader=PackageLoader("benchnav.eval.report", "templates"), autoescape=select_autoescape(),
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"markdown": markdown, "table": to_markdown, "inline": _inline, "pixels": _pixels}
    return environment.get_template(file).render(
        report=report,
        figures=figures,
        provenance=provenance_lines(report.about),
        commands=command_lines(report.about),
        version=benchnav.__version__,
    )


def provenance_lines(about: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Says where a run came from, (what, value).

    Args:
        about: all of `run.json`.
    """
    machine, codes, last = about["machine"], about["codes"].values(), about["history"][-1]
    lines = [("commit of benchnav", last["commit"]), ("version of benchnav", last["benchnav"])]
    for environment in {json.dumps(code["environment"]): code["environment"] for code in codes}.values():
        lines += [(name, str(value)) for name, value in environment.items()]
    lines.append(("machine", f"{machine['processor']}, {machine['cores']} cores"))
    for data, known in about["datasets"].items():
        maps = ", ".join(f"{split} {len(digests)}" for split, digests in known["maps"].items())
        lines.append((f"dataset {data}", f"{known['id']}; maps: {maps}"))
    lines += dict.fromkeys(part for code in codes for part in code["parts"].items())
    metrics = [entry for code in codes for entry in code.get(METRICS, {}).items()]
    lines += dict.fromkeys((f"metric {column}", own["digest"]) for column, own in metrics)
    seeds = dict.fromkeys(seed for condition in about["conditions"].values() for seed in condition["seeds"])
    lines.append(("seeds", ", ".join(map(str, seeds))))
    return [(name, value) for name, value in lines if value]


def _inline(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def _pixels(path: Path) -> int:
    """The width of a PNG, which its header holds."""
    return int.from_bytes(path.read_bytes()[16:20])
