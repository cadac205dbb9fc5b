"""Compares conditions of one run or several: reads them, refuses what else differs, and
writes the table.
"""

import json
import math
import time
from collections import Counter
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
from benchnav.core.store import write_text
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
from benchnav.eval.words import reading_name

_CAPTION = (
    "Differences between conditions that met the same maps with the same draws of λ."
)
_LISTED, _NAMED = 8, 3
_MIN_DIFFERENCE = 1e-5  # of success; a run has 10⁸ episodes at most
# From so many pairs on their time is announced, from that of a few.
_MANY, _TIMED = 5_000, 5


def compare_runs(
    folders: Sequence[Path],
    by: str,
    against: str,
    asked: Mapping[str, Sequence[str]],
    difference: float,
    allow_different_code: bool = False,
    metric: str = "",
) -> tuple[pd.DataFrame, Table]:
    """Compares the conditions of runs pair by pair.

    Args:
        folders: finished runs.
        by: in what conditions differ; see `pairs.by_what`.
        against: what all others are compared with; all pairs when empty.
        asked: labels of the conditions that are looked at, by column; of columns that
            are not named all.
        difference: of success, for which the maps needed are counted.
        allow_different_code: compare what other code made too, and say so in the table.
            Runs that are compared with each other always are.
        metric: name of the metric that is compared; if empty, success and T_total are.

    Returns:
        The numbers, and the table that is shown.

    Raises:
        ConfigError: there is nothing to compare, it cannot be paired, or code differs.
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
    conditions = _chosen(read_conditions(runs), asked)
    check_one_value_each(conditions)
    by = by_what(conditions, by, against)
    if by != "run":
        conditions = _once_each(conditions)
    _announce(conditions, by, against, difference)
    pairs = find_pairs(conditions, by, against)
    unlike = [_unlike_code(pair.members) for pair in pairs]
    # Versions and machines may differ between rows; what a label names may not.
    members = {member for pair in pairs for member in pair.members}
    lines = _unlike_code(members, parts_alone=not any(unlike))
    if lines and by != "run" and not allow_different_code:
        raise ConfigError(
            f"Expected conditions that differ in their {by} alone, got conditions "
            "made by different code: "
            f"{'; '.join(lines)}. Run them with one code, or pass --allow-different "
            "code, which names it in the table."
        )
    if quantity is None:
        table = compare(pairs, difference)
        shown = comparison_table(table, difference, by)
    else:
        table = compare_by(pairs, quantity)
        shown = metric_table(table, quantity, by)
    table = table.assign(different_code=["; ".join(found) for found in unlike])
    notes = (
        *_about(pairs, table),
        *_left_out(pairs, by),
        *_no_partner(conditions, pairs, by),
        *shown.notes,
    )
    notes += tuple(f"Different code: {line}." for line in lines)
    notes += tuple(
        dict.fromkeys(
            line for run in runs for line in caveats(_concerning(conditions, run.about))
        )
    )
    return table, replace(shown, notes=notes)


def _find_quantity(runs: Sequence[Run], name: str) -> Quantity:
    """What is compared, which every run must have.

    Raises:
        ConfigError: If a run does not have it.
    """
    for run in runs:
        known = quantities(further_quantities(run.about))
        check_known(f"`metric`, of {run.folder},", name, known)
    return known[name]


def write_comparison(stem: Path, table: pd.DataFrame, shown: Table) -> list[Path]:
    """Writes a comparison as CSV, with all its numbers, Markdown and LaTeX.

    Args:
        stem: path without a suffix.
        table: the numbers.
        shown: the table.

    Returns:
        What was written.
    """
    texts = {
        ".csv": table.to_csv(index=False, float_format="%.6g"),
        ".md": to_markdown(shown),
        ".tex": to_latex([shown], _CAPTION, stem.name),
    }
    written = {
        stem.with_name(stem.name + suffix): text for suffix, text in texts.items()
    }
    for path, text in written.items():
        write_text(path, text)
    return list(written)


def read_conditions(runs: Sequence[Run]) -> list[Compared]:
    """Reads the conditions of runs, each with its episodes.

    Raises:
        ConfigError: a run is not finished, or there twice.
    """
    names = _names([run.folder for run in runs])
    shared = Counter(condition for run in runs for condition in run.conditions)
    found = []
    for run, name in zip(runs, names, strict=True):
        episodes = dict(
            list(read_table(run.folder, EPISODES).groupby("condition", sort=False))
        )
        for condition, (known, _) in run.conditions.items():
            labels, value, rows = known.labels, known.value, episodes[condition]
            dataset = run.about["datasets"][labels["data"]]
            found.append(
                Compared(
                    labels={
                        **labels,
                        "run": name if shared[condition] > 1 else NOT_USED,
                    },
                    value=value,
                    maps=dataset["maps"][value["split"]],
                    episodes=rows.assign(
                        time_budget_s=time_budgets(rows, value["world"])
                    ),
                    code=_codes(run.about, name, rows["code"].unique()),
                    about=dataset.get("about", {}).get(value["split"], ""),
                )
            )
    return found


def _announce(
    conditions: Sequence[Compared], by: str, against: str, difference: float
) -> None:
    """Print on stderr about how long a comparison of many pairs takes, from the time of
    a few.
    """
    every = (
        list(matches(conditions, by, against))
        if math.comb(len(conditions), 2) >= _MANY
        else []
    )
    if len(every) < _MANY:
        return
    begin = time.perf_counter()
    compare(
        find_pairs(list(dict.fromkeys(chain(*every[:_TIMED]))), by, against)[:_TIMED],
        difference,
    )
    seconds = (time.perf_counter() - begin) / _TIMED * len(every)
    tell(
        f"benchnav-eval: comparing {len(every)} pairs takes about "
        f"{timedelta(seconds=round(seconds))}."
    )


def _codes(
    about: Mapping[str, Any], run: str, digests: Iterable[str]
) -> dict[str, Any]:
    """The code of some rows of a run, by the run's name, and by digests too where it
    holds rows of other code.
    """
    if about["reused"]:
        return {f"{run} (code {digest})": about["codes"][digest] for digest in digests}
    (digest,) = digests
    return {run: about["codes"][digest]}


def _names(folders: Sequence[Path]) -> list[str]:
    """Short names of runs, with as much of the path as tells them apart."""
    paths = [folder.resolve() for folder in folders]
    if len(set(paths)) < len(paths):
        raise ConfigError(
            f"Expected runs that differ, got {', '.join(map(str, folders))}."
        )
    parts = next(
        n
        for n in range(1, 100)
        if len({path.parts[-n:] for path in paths}) == len(paths)
    )
    return ["/".join(path.parts[-parts:]) for path in paths]


def _chosen(
    chosen: list[Compared], asked: Mapping[str, Sequence[str]]
) -> list[Compared]:
    for name, values in asked.items():
        known = dict.fromkeys(condition.labels[name] for condition in chosen)
        for value in values:
            check_known(f"`{name}`", value, known)
        chosen = [condition for condition in chosen if condition.labels[name] in values]
    return chosen


def _unlike_code(
    conditions: Iterable[Compared], parts_alone: bool = False
) -> list[str]:
    """What of the code that made conditions differs, a line for two runs; perhaps of
    parts and sources alone.
    """
    codes: dict[str, dict[str, dict[str, Any]]] = {}
    for condition in conditions:
        for run, code in condition.code.items():
            groups = codes.setdefault(run, {})
            for group, known in code.items():
                is_left_out = parts_alone and group == "environment"
                groups[group] = groups.get(group, {}) | ({} if is_left_out else known)
    return [
        f"{second} differs from {first} in {', '.join(names)}"
        for first, second in combinations(sorted(codes), 2)
        if (names := code_differences(codes[first], codes[second]))
    ]


def _once_each(conditions: Iterable[Compared]) -> list[Compared]:
    """Makes one of each condition that several runs hold, with the episodes of all.

    Raises:
        ConfigError: an episode came out differently in two runs.
    """
    found: dict[str, Compared] = {}
    for condition in conditions:
        name = json.dumps(condition.value, sort_keys=True)
        earlier = found.setdefault(name, condition)
        if earlier is not condition:
            found[name] = _joined(earlier, condition)
    return list(found.values())


def _joined(one: Compared, other: Compared) -> Compared:
    runs, words = (
        " and ".join([*one.code, *other.code]),
        " ".join(label_words(one.labels)),
    )
    check_maps(one, other, f"{words} in {runs}")
    first, second = (
        condition.episodes.drop(columns=list(LABELS)) for condition in (one, other)
    )
    cells, _ = differences(first, second)
    if len(cells):
        unlike = cells.index.droplevel(-1).unique()
        both = len(first.merge(second, on=DRAW))
        why = "; ".join(_unlike_code((one, other)))
        raise ConfigError(
            "Expected the same rows of a condition in all runs that hold it, got "
            f"{len(unlike)} of {both} episodes of "
            f"{words} that differ between {runs}{f' ({why})' if why else ''}. Leave "
            "one of the runs out, or "
            "compare the runs with each other by --by run."
        )
    rows = pd.concat([one.episodes, other.episodes]).drop_duplicates(
        DRAW, ignore_index=True
    )
    longer = max((one.maps, other.maps), key=len)
    labels = {**one.labels, "run": NOT_USED}
    return replace(
        one, labels=labels, episodes=rows, maps=longer, code={**one.code, **other.code}
    )


def _about(pairs: Sequence[Pair], table: pd.DataFrame) -> list[str]:
    same = [
        f"{name} {reading_name(name, table[name].iloc[0])}"
        for name in LABELS
        if name in table
        and table[name].nunique() == 1
        and table[name].iloc[0] != NOT_USED
    ]
    if all(table[name].nunique() == 1 for name in ("n_maps", "n_groups", "n_episodes")):
        maps, groups, episodes = table[["n_maps", "n_groups", "n_episodes"]].iloc[0]
        same.append(f"{maps} maps")
        if groups != maps:
            same.append(f"{groups} groups of maps (the statistical unit)")
        same.append(f"{episodes} episodes a condition")
    return [f"All pairs: {', '.join([*same, 'the same draws of λ'])}."]


def _left_out(pairs: Sequence[Pair], by: str) -> list[str]:
    """Says which episodes of a condition its partner was not run on."""
    lines: dict[str, None] = {}
    for pair in pairs:
        one, other = (reading_name(by, label) for label in (pair.one, pair.other))
        sides = (one, other), (other, one)
        for condition, (own, partner) in zip(pair.members, sides, strict=True):
            both = condition.episodes[DRAW].merge(
                pair.episodes[DRAW], how="left", indicator=True
            )
            rows = both[both["_merge"] == "left_only"]
            places = [
                f"seed {seed}"
                + (f", realisation {realisation}" if realisation else "")
                + f" on {_maps(sorted(maps))}"
                for (seed, realisation), maps in rows.groupby(["seed", "realisation"])[
                    "map"
                ]
            ]
            if places:
                more = (
                    f" and {len(places) - _NAMED} more draws"
                    if len(places) > _NAMED
                    else ""
                )
                line = (
                    f"{len(rows)} of {len(condition.episodes)} episodes of {own} are "
                    f"left out: {partner} was not run "
                    f"on them ({'; '.join(places[:_NAMED])}{more})."
                )
                lines[line] = None
    return _first_of(list(lines), "pairs with episodes left out")


def _maps(maps: Sequence[int]) -> str:
    """Numbers of maps in words; runs of them by their ends."""
    if len(maps) == 1:
        return f"map {maps[0]}"
    if maps[-1] - maps[0] == len(maps) - 1:
        return f"maps {maps[0]} to {maps[-1]}"
    more = ", …" if len(maps) > _NAMED else ""
    return f"{len(maps)} maps ({', '.join(map(str, maps[:_NAMED]))}{more})"


def _concerning(
    conditions: Sequence[Compared], about: Mapping[str, Any]
) -> dict[str, Any]:
    """What a run is about; of what it left out those combinations whose labels are all
    compared.
    """
    known = {
        name: {condition.labels[name] for condition in conditions} for name in LABELS
    }
    dropped = [
        entry
        for entry in about["dropped"]
        if all(label in known[name] for name, label in dropped_labels(entry).items())
    ]
    return {**about, "dropped": dropped}


def _no_partner(
    conditions: Sequence[Compared], pairs: Sequence[Pair], by: str
) -> list[str]:
    """Names the conditions that are in no pair."""
    paired = {member for pair in pairs for member in pair.members}
    alone = [condition for condition in conditions if condition not in paired]
    varying = [
        name
        for name in (*LABELS, "run")
        if len({condition.labels[name] for condition in conditions}) > 1
    ]
    names = [
        " ".join(label_words(_as_read(condition.labels), varying))
        for condition in alone
    ]
    if not names:
        return []
    return [
        f"Not in the table, since no condition differs from them in {by} alone: "
        f"{'; '.join(_first_of(names, 'conditions'))}."
    ]


def _as_read(labels: Mapping[str, str]) -> dict[str, str]:
    return {name: reading_name(name, label) for name, label in labels.items()}


def _first_of(lines: list[str], what: str) -> list[str]:
    return (
        lines
        if len(lines) <= _LISTED
        else [*lines[:_LISTED], f"and {len(lines) - _LISTED} more {what}"]
    )
