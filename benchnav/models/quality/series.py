"""Series of shifts, which splits make by their names.

A split is one of a series where its name ends in the severity: in hundredths after a dash (`test/hg-050`),
or as a number after an @ (`test/hg@0.5`). What stands before is the scenario; the split `std` of the same folder
is severity 0 of each, and a split of the scenario's own name (`test/hg`) severity 1. Every other split stands by
itself.
"""

import re
from collections.abc import Iterable

SeriesOfShifts = dict[str, list[tuple[float, str]]]

_NAMED = re.compile(r"(?P<scenario>.*[^/])(-(?P<hundredths>\d{3})|@(?P<severity>\d+(\.\d+)?))")


def find_series(splits: Iterable[str]) -> SeriesOfShifts:
    """Finds the series of shifts among splits by their names.

    Args:
        splits: names of splits.

    Returns:
        By scenario, its pairs as (severity, split), ascending, with `std` at severity 0 and the scenario itself at 1
        where they are there; scenarios with fewer than two pairs are left out.
    """
    splits = list(splits)
    all_series: SeriesOfShifts = {}
    for split in splits:
        if named := _NAMED.fullmatch(split):
            hundredths = named["hundredths"]
            severity = int(hundredths) / 100 if hundredths else float(named["severity"])
            all_series.setdefault(named["scenario"], []).append((severity, split))
    for scenario, pairs in all_series.items():
        folder, slash, _ = scenario.rpartition("/")
        if f"{folder}{slash}std" in splits and all(severity > 0 for severity, _ in pairs):
            pairs.append((0.0, f"{folder}{slash}std"))
        if scenario in splits and all(severity != 1 for severity, _ in pairs):
            pairs.append((1.0, scenario))
        pairs.sort()
    return {scenario: pairs for scenario, pairs in all_series.items() if len(pairs) > 1}
