"""Comparison of conditions of one or several runs: reading, checks and tables."""

import json
import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.command import tell
from benchnav.core.errors import ConfigError
from benchnav.core.quantity import Quantity
from benchnav.core.settings import check_known
from benchnav.core.store import write_texts
from benchnav.core.tables import Table, to_latex, to_markdown
from benchnav.eval.experiment.condition import LABELS, NOT_USED, label_words
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.experiment.unit import DRAW
from benchnav.eval.folder.provenance import code_differences
from benchnav.eval.folder.run_folder import (
    EPISODES,
    Run,
    caveats,
    differences,
    dropped_labels,
    open_run,
    read_table,
)
from benchnav.eval.report.comparison_tables import comparison_table, metric_table
from benchnav.eval.stats.comparison import compare, compare_by
from benchnav.eval.stats.pairs import (
    Compared,
    Pair,
    by_what,
    check_maps,
    check_one_value_each,
    find_pairs,
    matches,
)
from benchnav.eval.stats.summary import time_budgets
from benchnav.eval.words import display_name

_CAPTION = "Differences between conditions on the same maps with the same draws of λ."
_MAX_LISTED = 8  # maximum number of lines of a note
_MAX_NAMED = 3  # maximum number of draws or maps in a line
_MIN_DIFFERENCE = 1e-5  # minimum in success rate; a run has at most 10⁸ episodes
# For at least _MANY pairs, the time is estimated from the time of _TIMED pairs.
_MANY = 5_000
_TIMED = 5


def compare_runs(
    folders: Sequence[Path],
    by: str,
    against: str,
    labels: Mapping[str, Sequence[str]],
    difference: float,
    allow_different_code: bool = False,
    metric: str = "",
) -> tuple[pd.DataFrame, Table]:
    """Compare the conditions of runs pair by pair.

    Args:
        folders: finished runs.
        by: column in which the conditions of a pair differ; if empty, see
            `pairs.by_what`.
        against: label with which all other conditions are compared; if empty, all pairs
            are compared.
        labels: labels that select conditions, by column; a missing column selects all.
        difference: difference in success rate, as a fraction, for which the required
            number of maps is computed.
        allow_different_code: whether to compare conditions that were run with different
            code, with a note. With `by` "run", they are always compared.
        metric: name of a metric; if empty, success and T_total are compared.

    Returns:
        The numbers, one row for each pair, and the formatted table.

    Raises:
        ConfigError: If there is nothing to compare, conditions cannot be paired, or
            their code differs.
    """
    if not folders:
        raise ConfigError("Expected one or more run folders, got none.")
    if not _MIN_DIFFERENCE <= difference <= 1:
        raise ConfigError(
            f"Expected `points` in [{100 * _MIN_DIFFERENCE:g}, 100], got "
            f"{100 * difference:g}."
        )
    runs = [open_run(folder) for folder in folders]
    quantity = _find_quantity(runs, metric) if metric else None
    conditions = select_conditions(read_conditions(runs), labels)
    check_one_value_each(conditions)
    by = by_what(conditions, by, against)
    if by != "run":
        conditions = merge_runs(conditions)
    _announce(conditions, by, against, difference)
    pairs = find_pairs(conditions, by, against)
    code_by_pair = [_unlike_code(pair.members) for pair in pairs]
    # The environment may differ between pairs, but not the code of a part.
    compared = {condition for pair in pairs for condition in pair.members}
    code_lines = _unlike_code(compared, only_parts=not any(code_by_pair))
    if code_lines and by != "run" and not allow_different_code:
        raise ConfigError(
            f"Expected conditions that differ only in their {by}, got conditions that "
            f"were run with different code: {'; '.join(code_lines)}. Run them with the "
            "same code, or pass `--allow-different code`, which adds a note to the "
            "table."
        )
    if quantity is None:
        table = compare(pairs, difference)
        shown = comparison_table(table, difference, by)
    else:
        table = compare_by(pairs, quantity)
        shown = metric_table(table, quantity, by)
    table["different_code"] = ["; ".join(lines) for lines in code_by_pair]
    notes = _common(table)
    notes += _left_out(pairs, by)
    notes += _unpaired(conditions, pairs, by)
    notes += shown.notes
    notes += [f"Different code: {line}." for line in code_lines]
    caveat_lines: list[str] = []
    for run in runs:
        caveat_lines += caveats(_relevant_manifest(conditions, run.manifest))
    notes += dict.fromkeys(caveat_lines)
    return table, replace(shown, notes=tuple(notes))


def _find_quantity(runs: Sequence[Run], name: str) -> Quantity:
    """Return the quantity of a metric, which all runs must have.

    Raises:
        ConfigError: If a run does not have the metric.
    """
    for run in runs:
        known_quantities = quantities(further_quantities(run.manifest))
        check_known(f"`metric` of {run.folder}", name, known_quantities)
    return known_quantities[name]


def write_comparison(stem: Path, table: pd.DataFrame, shown: Table) -> list[Path]:
    """Write a comparison as CSV, Markdown and LaTeX.

    Args:
        stem: path without a suffix.
        table: the numbers, for CSV.
        shown: the formatted table.

    Returns:
        The paths written.
    """
    texts = {
        ".csv": table.to_csv(index=False, float_format="%.6g"),
        ".md": to_markdown(shown),
        ".tex": to_latex([shown], _CAPTION, stem.name),
    }
    return write_texts(stem, texts)


def read_conditions(runs: Sequence[Run]) -> list[Compared]:
    """Read the conditions of runs, each with its episodes.

    Raises:
        ConfigError: If a run is not finished, or listed twice.
    """
    names = _names([run.folder for run in runs])
    shared = Counter(condition for run in runs for condition in run.conditions)
    compared = []
    for run, name in zip(runs, names, strict=True):
        table = read_table(run.folder, EPISODES)
        episodes = dict(list(table.groupby("condition", sort=False)))
        for condition_id, (condition, _) in run.conditions.items():
            labels = dict(condition.labels)
            labels["run"] = name if shared[condition_id] > 1 else NOT_USED
            value = condition.value
            split = value["split"]
            rows = episodes[condition_id]
            budgets = time_budgets(rows, value["world"])
            dataset = run.manifest["datasets"][labels["data"]]
            properties = dataset.get("about", {})
            entry = Compared(
                labels=labels,
                value=value,
                maps=dataset["maps"][split],
                episodes=rows.assign(time_budget_s=budgets),
                code=_codes(run.manifest, name, rows["code"].unique()),
                map_properties=properties.get(split, ""),
            )
            compared.append(entry)
    return compared


def _announce(
    conditions: Sequence[Compared], by: str, against: str, difference: float
) -> None:
    """Estimate on stderr how long a comparison of many pairs takes."""
    if math.comb(len(conditions), 2) < _MANY:
        return
    all_pairs = list(matches(conditions, by, against))
    if len(all_pairs) < _MANY:
        return
    sample = list(dict.fromkeys(chain(*all_pairs[:_TIMED])))
    begin_s = time.perf_counter()
    compare(find_pairs(sample, by, against)[:_TIMED], difference)
    s_per_pair = (time.perf_counter() - begin_s) / _TIMED
    estimate = timedelta(seconds=round(s_per_pair * len(all_pairs)))
    tell(f"benchnav-eval: comparing {len(all_pairs)} pairs takes about {estimate}.")


def _codes(
    manifest: Mapping[str, Any], run: str, digests: Iterable[str]
) -> dict[str, Any]:
    """Return the code of some rows, by the name of their run.

    If the run may have rows of several codes, the name also contains the code's digest.

    Args:
        manifest: contents of `run.json`.
        run: name of the run.
        digests: digests of the rows' code.
    """
    codes = manifest["codes"]
    if manifest["reused"]:
        return {f"{run} (code {digest})": codes[digest] for digest in digests}
    (digest,) = digests
    return {run: codes[digest]}


def _names(folders: Sequence[Path]) -> list[str]:
    """Return short names of runs: the last parts of their paths, as many as differ."""
    paths = [folder.resolve() for folder in folders]
    if len(set(paths)) < len(paths):
        raise ConfigError(
            f"Expected runs that differ, got {', '.join(map(str, folders))}. List each "
            "run once."
        )
    n_parts = 1
    while len({path.parts[-n_parts:] for path in paths}) < len(paths):
        n_parts += 1
    return ["/".join(path.parts[-n_parts:]) for path in paths]


def select_conditions(
    conditions: list[Compared], labels: Mapping[str, Sequence[str]]
) -> list[Compared]:
    """Return the conditions with some labels; a missing column selects all."""
    for name, values in labels.items():
        known_labels = dict.fromkeys(condition.labels[name] for condition in conditions)
        for value in values:
            check_known(f"`{name}`", value, known_labels)
        conditions = [
            condition for condition in conditions if condition.labels[name] in values
        ]
    return conditions


def _unlike_code(conditions: Iterable[Compared], only_parts: bool = False) -> list[str]:
    """Describe differences in the code of conditions, one line for each pair of runs.

    Args:
        conditions: conditions whose code is compared.
        only_parts: whether to ignore differences in the environment (versions,
            processor, device).
    """
    codes: dict[str, dict[str, dict[str, Any]]] = {}
    for condition in conditions:
        for run, code in condition.code.items():
            groups = codes.setdefault(run, defaultdict(dict))
            for group, entries in code.items():
                if not only_parts or group != "environment":
                    groups[group].update(entries)
    lines = []
    for first, second in combinations(sorted(codes), 2):
        names = code_differences(codes[first], codes[second])
        if names:
            lines.append(f"{second} differs from {first} in {', '.join(names)}")
    return lines


def merge_runs(conditions: Iterable[Compared]) -> list[Compared]:
    """Merge each condition that several runs contain, with the episodes of all runs.

    Raises:
        ConfigError: If an episode differs between two runs.
    """
    merged: dict[str, Compared] = {}
    for condition in conditions:
        name = json.dumps(condition.value, sort_keys=True)
        earlier = merged.setdefault(name, condition)
        if earlier is not condition:
            merged[name] = _joined(earlier, condition)
    return list(merged.values())


def _joined(a: Compared, b: Compared) -> Compared:
    runs = " and ".join([*a.code, *b.code])
    words = " ".join(label_words(a.labels))
    check_maps(a, b, f"{words} in {runs}")
    first = a.episodes.drop(columns=list(LABELS))
    second = b.episodes.drop(columns=list(LABELS))
    cells, _ = differences(first, second)
    if len(cells):
        n_unlike = len(cells.index.droplevel(-1).unique())
        n_common = len(first.merge(second, on=DRAW))
        reasons = "; ".join(_unlike_code((a, b)))
        explanation = f" ({reasons})" if reasons else ""
        raise ConfigError(
            "Expected the same rows of a condition in all runs that contain it, got "
            f"{n_unlike} of {n_common} episodes of {words} that differ between "
            f"{runs}{explanation}. Leave one of the runs out, or pass --by run to "
            "compare the runs with each other."
        )
    rows = pd.concat([a.episodes, b.episodes])
    return replace(
        a,
        labels={**a.labels, "run": NOT_USED},
        episodes=rows.drop_duplicates(DRAW, ignore_index=True),
        maps=max((a.maps, b.maps), key=len),
        code={**a.code, **b.code},
    )


def _common(table: pd.DataFrame) -> list[str]:
    """Return a note with the labels and counts that all pairs have in common."""
    words = []
    for name in LABELS:
        if name not in table or table[name].nunique() != 1:
            continue
        label = table[name].iloc[0]
        if label != NOT_USED:
            words.append(f"{name} {display_name(name, label)}")
    counts = table[["n_maps", "n_groups", "n_episodes"]].drop_duplicates()
    if len(counts) == 1:
        maps, groups, episodes = counts.iloc[0]
        words.append(f"{maps} maps")
        if groups != maps:
            words.append(f"{groups} groups of maps (the statistical unit)")
        words.append(f"{episodes} episodes per condition")
    words.append("the same draws of λ")
    return [f"All pairs: {', '.join(words)}."]


def _left_out(pairs: Sequence[Pair], by: str) -> list[str]:
    """Return lines on episodes that only one condition of a pair has."""
    lines: dict[str, None] = {}
    for pair in pairs:
        first = display_name(by, pair.one)
        second = display_name(by, pair.other)
        sides = (first, second), (second, first)
        for condition, (name, partner) in zip(pair.members, sides, strict=True):
            merged = condition.episodes[DRAW].merge(
                pair.episodes[DRAW], how="left", indicator=True
            )
            rows = merged[merged["_merge"] == "left_only"]
            if rows.empty:
                continue
            draws = _draws_in_words(rows)
            remainder = ""
            if len(draws) > _MAX_NAMED:
                remainder = f" and {len(draws) - _MAX_NAMED} more draws"
            line = (
                f"{len(rows)} of {len(condition.episodes)} episodes of {name} are "
                f"left out: {partner} was not run "
                f"on them ({'; '.join(draws[:_MAX_NAMED])}{remainder})."
            )
            lines[line] = None
    return _first_of(list(lines), "pairs with episodes left out")


def _draws_in_words(rows: pd.DataFrame) -> list[str]:
    """Return a text for each draw of λ: seed, realisation and maps."""
    draws = []
    for (seed, realisation), maps in rows.groupby(["seed", "realisation"])["map"]:
        words = f"seed {seed}"
        if realisation:
            words += f", realisation {realisation}"
        draws.append(f"{words} on {_maps(sorted(maps))}")
    return draws


def _maps(maps: Sequence[int]) -> str:
    """Return map indices in words; consecutive indices as a range."""
    if len(maps) == 1:
        return f"map {maps[0]}"
    if maps[-1] - maps[0] == len(maps) - 1:
        return f"maps {maps[0]} to {maps[-1]}"
    more = ", …" if len(maps) > _MAX_NAMED else ""
    return f"{len(maps)} maps ({', '.join(map(str, maps[:_MAX_NAMED]))}{more})"


def _relevant_manifest(
    conditions: Sequence[Compared], manifest: Mapping[str, Any]
) -> dict[str, Any]:
    """Return `run.json`, with left-out combinations only of compared labels."""
    compared: set[tuple[str, str]] = set()
    for condition in conditions:
        compared.update(condition.labels.items())
    dropped = [
        entry
        for entry in manifest["dropped"]
        if dropped_labels(entry).items() <= compared
    ]
    return {**manifest, "dropped": dropped}


def _unpaired(
    conditions: Sequence[Compared], pairs: Sequence[Pair], by: str
) -> list[str]:
    """Return a line that names conditions without a pair; empty if all are paired."""
    paired = {condition for pair in pairs for condition in pair.members}
    unpaired = [condition for condition in conditions if condition not in paired]
    varying = []
    for name in (*LABELS, "run"):
        labels = {condition.labels[name] for condition in conditions}
        if len(labels) > 1:
            varying.append(name)
    names = []
    for condition in unpaired:
        labels_shown = _as_read(condition.labels)
        names.append(" ".join(label_words(labels_shown, varying)))
    if not names:
        return []
    return [
        f"Conditions not in the table, since no other condition differs from them only "
        f"in {by}: {'; '.join(_first_of(names, 'conditions'))}."
    ]


def _as_read(labels: Mapping[str, str]) -> dict[str, str]:
    return {name: display_name(name, label) for name, label in labels.items()}


def _first_of(lines: list[str], noun: str) -> list[str]:
    if len(lines) <= _MAX_LISTED:
        return lines
    return [*lines[:_MAX_LISTED], f"and {len(lines) - _MAX_LISTED} more {noun}"]
