"""Tables and sentences that compare the worlds of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.core.tables import Bold, Table
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.experiment.hypotheses import Hypothesis
from benchnav.eval.stats.between import BetweenWorlds
from benchnav.eval.stats.world_blocks import BLOCK_LABELS, SETTING_LABELS
from benchnav.eval.words import (
    contender_names,
    differ,
    display_name,
    joined,
    p_in_words,
    shared_words,
    success_interval_in_words,
    world_names,
)
from benchnav.metrics.shipped import QUANTITIES
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.tables import Column, Row, cell_of, short, signed, table_of

TITLE = "Between worlds"
_MAX_NAMED = 6
_MARGIN_KINDS = ("non-inferiority", "superiority", "equivalence")


def between_tables(
    compared: BetweenWorlds,
    unit: str,
    quantities_by_name: Mapping[str, Quantity] = QUANTITIES,
) -> tuple[Table, ...]:
    """Format the comparison of a run's worlds; no tables if it has only one world.

    Args:
        compared: comparison from `between.compare_worlds`.
        unit: statistical unit, from `words.unit_of_statistics`.
        quantities_by_name: quantities by which conditions are compared.

    Returns:
        Tables of settings, of pairs of worlds and, if the run has any, of hypotheses.
    """
    if compared.settings.empty:
        return ()
    tables = [_settings_table(compared, unit)]
    if not compared.agreement.empty:
        tables.append(_agreement_table(compared, unit))
    if not compared.hypotheses.empty:
        tables.append(_hypotheses_table(compared, quantities_by_name))
    return tuple(tables)


def between_findings(compared: BetweenWorlds) -> list[str]:
    """Describe the robust set of each block, or the least worst regret without one."""
    if compared.settings.empty:
        return []
    sentences = []
    for title, rows in _blocks(_with_names(compared.settings)):
        competing = rows[rows["competes"]]
        if competing.empty:
            continue
        sentence = _robust_sentence(competing)
        sentences.append(f"{title}: {sentence}" if title else _capital(sentence))
    return sentences


def _robust_sentence(rows: pd.DataFrame) -> str:
    """Return a sentence on the robust set of a block, from its competing settings."""
    n_worlds = rows["world"].nunique()
    by_setting = rows.drop_duplicates("name")
    robust = by_setting[by_setting["robust"]]
    level = f"each at level {ALPHA:g}/{n_worlds}"
    if robust.empty:
        least = by_setting.loc[by_setting["regret"].idxmin()]
        return (
            f"no setting is in the best set of all {n_worlds} worlds, {level}. "
            f"{least['name']} has the least worst regret: {_regret(least)} points."
        )
    if len(robust) == len(by_setting):
        number = (
            "the only setting" if len(robust) == 1 else f"all {len(robust)} settings"
        )
        return (
            f"no setting is significantly worse than the best of a world, {level}; the "
            f"robust set contains {number}."
        )
    names = list(robust["name"])
    listed = "; ".join(names[:_MAX_NAMED])
    if len(names) > _MAX_NAMED:
        listed += f"; and {len(names) - _MAX_NAMED} more"
    return (
        f"{len(robust)} of {len(by_setting)} settings are in the best set of all "
        f"{n_worlds} worlds, {level} (robust set): {listed}."
    )


def _with_names(settings: pd.DataFrame) -> pd.DataFrame:
    """Return the table of settings with a column `name`."""
    labels = settings[list(SETTING_LABELS)]
    names = contender_names(labels.to_dict("records"))
    return settings.assign(name=names)


def _blocks(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return the title and the rows of each block; one block has an empty title."""
    differing = [name for name in BLOCK_LABELS if rows[name].nunique() > 1]
    blocks = []
    for _, block in rows.groupby(list(BLOCK_LABELS), sort=False):
        title = joined(str(block[name].iloc[0]) for name in differing)
        blocks.append((title, block))
    return blocks


def _block_columns(rows: pd.DataFrame) -> list[Column]:
    """Return columns with the labels of blocks that differ."""
    names = [name for name in BLOCK_LABELS if differ(rows[name])]
    return [Column(name, cell_of(name, partial(display_name, name))) for name in names]


def _settings_table(compared: BetweenWorlds, unit: str) -> Table:
    """Format success of each setting in each world, with the worst regret."""
    settings = _with_names(compared.settings)
    short_names = world_names(compared.worlds)
    keys = list(SETTING_LABELS)
    rows = []
    for _, group in settings.groupby(keys, sort=False):
        first = group.iloc[0].to_dict()
        rates = {row["world"]: row for row in group.to_dict("records")}
        rows.append({**first, "rates": rates})
    # As in the table of conditions, nothing is bold if no setting is worse.
    is_worse = settings["competes"] & ~settings["in_best"]
    has_bold = is_worse.any()
    columns = _block_columns(settings)
    columns.append(Column("setting", cell_of("name")))
    n_labels = len(columns)
    for world, name in short_names.items():
        columns.append(Column(name, partial(_rate, world, bool(has_bold))))
    columns.append(
        Column(
            "worst regret [points]",
            _regret,
            "largest difference over worlds between the best setting's success and the "
            f"setting's own, with a 95 % bootstrap interval over {unit}s; a dash for a "
            "setting that does not compete: a privileged model, or not run in all "
            "worlds.",
        )
    )
    columns.append(
        Column(
            "robust",
            lambda row: (
                ("yes" if row["robust"] else "no") if row["competes"] else NOT_USED
            ),
            "whether the setting is in the best set of all worlds, each at level "
            f"{ALPHA:g} divided by the number of worlds.",
        )
    )
    bold_note = ""
    if has_bold:
        bold_note = (
            "in the best set of the world: not significantly worse than its best."
        )
    notes = ["Success [%] in each world, with its 95 % interval in brackets."]
    shared = shared_words(compared.worlds)
    if shared:
        notes.append(f"Names of worlds leave out what all worlds share: {shared}.")
    return table_of(
        rows,
        columns,
        n_labels=n_labels,
        title=TITLE,
        notes=tuple(notes),
        bold_note=bold_note,
    )


def _rate(world: str, has_bold: bool, row: Row) -> str:
    rates = row["rates"].get(world)
    if rates is None or np.isnan(rates["success_rate"]):
        return NOT_USED
    text = f"{short(100 * rates['success_rate'])} ({success_interval_in_words(rates)})"
    return Bold(text) if has_bold and rates["in_best"] else text


def _regret(row: Row) -> str:
    if not row["competes"]:
        return NOT_USED
    return _with_interval(row, "regret", 100, 1)


def _with_interval(row: Row, name: str, scale: float, digits: int) -> str:
    """Format an estimate with its interval; a dash if it is not defined."""
    value, low, high = (scale * row[f"{name}{end}"] for end in ("", "_low", "_high"))
    if np.isnan(value):
        return NOT_USED
    text = f"{value:.{digits}f}"
    if np.isnan(low):
        return text
    return f"{text} ({low:.{digits}f} to {high:.{digits}f})"


def _agreement_table(compared: BetweenWorlds, unit: str) -> Table:
    """Format the agreement of each pair of worlds."""
    rows = compared.agreement
    names = world_names(compared.worlds)
    as_name = names.__getitem__
    columns = [
        *_block_columns(rows),
        Column("world", cell_of("world", as_name)),
        Column("other", cell_of("other", as_name)),
    ]
    n_labels = len(columns)
    back = "the same with both worlds exchanged."
    columns += [
        Column("settings", cell_of("n_settings"), "number of compared settings."),
        Column(
            "r",
            lambda row: _with_interval(row, "pearson", 1, 2),
            "Pearson's correlation of the settings' success in both worlds.",
        ),
        Column(
            "ρ",
            lambda row: _with_interval(row, "spearman", 1, 2),
            "Spearman's rank correlation.",
        ),
        Column(
            "MMRV → [points]",
            lambda row: _with_interval(row, "mmrv", 100, 1),
            "mean maximum rank violation of SIMPLER: for each setting, the largest "
            "difference in the first world to a setting that the other world ranks "
            "differently; mean over settings. 0 if both worlds agree on all ranks.",
        ),
        Column(
            "MMRV ← [points]",
            lambda row: _with_interval(row, "mmrv_back", 100, 1),
            back,
        ),
        Column(
            "κ",
            lambda row: _with_interval(row, "kappa", 1, 2),
            "Cohen's κ of the success of episodes in both worlds, over all settings: 1 "
            "for full agreement, 0 for agreement by chance.",
        ),
        Column(
            "same sign →",
            partial(_same_sign, ""),
            "pairs of settings that differ significantly in the first world and have "
            "the same sign in the other, with the lower end of a one-sided 95 % "
            "interval of their fraction.",
        ),
        Column("same sign ←", partial(_same_sign, "_back"), back),
    ]
    notes = [
        f"95 % bootstrap intervals over {unit}s, the same {unit}s in both worlds; none "
        f"below {LEAST_MAPS} {unit}s, or if a value is undefined in a sample, such as "
        "r of equal rates. They are described, not tested. Sampling variation lowers "
        "correlations and raises rank violations.",
    ]
    unlike = rows[~rows["same_draws"]]
    if not unlike.empty:
        pairs = unlike[["world", "other"]].drop_duplicates()
        listed = "; ".join(
            f"{names[first]} and {names[second]}"
            for first, second in pairs.itertuples(index=False)
        )
        notes.append(f"Worlds that draw λ differently on the same map: {listed}.")
    return table_of(
        rows.to_dict("records"),
        columns,
        n_labels=n_labels,
        title="Agreement between worlds",
        notes=tuple(notes),
    )


def _same_sign(suffix: str, row: Row) -> str:
    n_pairs = row[f"n_pairs{suffix}"]
    if not n_pairs:
        return NOT_USED
    n_same = round(row[f"same_sign{suffix}"] * n_pairs)
    text = f"{n_same} of {n_pairs}"
    low = row[f"same_sign_low{suffix}"]
    return text if np.isnan(low) else f"{text} (≥ {100 * low:.0f} %)"


def _hypotheses_table(
    compared: BetweenWorlds, quantities_by_name: Mapping[str, Quantity]
) -> Table:
    """Format each hypothesis in each world."""
    numbers = list(compared.setting_labels)
    sides = [labels for number in numbers for labels in compared.setting_labels[number]]
    names = contender_names(sides)
    settings = pd.DataFrame(sides)
    rows = []
    for index, number in enumerate(numbers):
        tests = compared.hypotheses[compared.hypotheses["number"] == number]
        records = tests.to_dict("records")
        first = records[0]
        claim = _claim(first, names[2 * index : 2 * index + 2], quantities_by_name)
        by_world = {record["world"]: record for record in records}
        row = {
            **sides[2 * index],
            "number": number,
            "claim": claim,
            "by_world": by_world,
        }
        rows.append(row)
    columns = [
        Column("", cell_of("number")),
        *_block_columns(settings),
        Column("hypothesis", cell_of("claim")),
    ]
    n_labels = len(columns)
    for world, name in world_names(compared.worlds).items():
        columns.append(Column(name, partial(_test, world)))
    columns.append(
        Column("sign", _sign, "whether the difference has the same sign in all worlds.")
    )
    notes = (
        "Difference, interval and p in each world. The interval is 95 % for a "
        "difference and 90 % for a margin. p is not corrected; the table of hypotheses "
        "has the corrected tests.",
    )
    return table_of(
        rows,
        columns,
        n_labels=n_labels,
        title="Hypotheses in each world",
        notes=notes,
        bold_note="world for which the hypothesis was fixed before the run.",
    )


def _claim(
    row: Row, names: Sequence[str], quantities_by_name: Mapping[str, Quantity]
) -> str:
    stated = {item.name: row[item.name] for item in fields(Hypothesis)}
    first, second = names
    return Hypothesis(**stated).claim(first, second, quantities_by_name[row["metric"]])


def _test(world: str, row: Row) -> str:
    test = row["by_world"].get(world)
    if test is None or np.isnan(test["difference"]):
        return NOT_USED
    suffix = "_90" if test["kind"] in _MARGIN_KINDS else ""
    low = test[f"low{suffix}"]
    high = test[f"high{suffix}"]
    words = [f"{_signed(test['difference'])} {test['unit']}".rstrip()]
    if not np.isnan(low):
        words.append(f"({_signed(low)} to {_signed(high)})")
    text = f"{' '.join(words)}, {p_in_words(test['p'])}"
    return Bold(text) if test["registered"] else text


def _sign(row: Row) -> str:
    signs = {np.sign(test["difference"]) for test in row["by_world"].values()}
    return "same" if len(signs) == 1 else "differs"


def _signed(value: Any) -> str:
    return signed(value, 1 if abs(value) >= 0.95 else 2)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
