"""Ladders of shifts, which splits make by their names.

A split is a rung of a ladder where its name ends in the severity: in hundredths after a dash (`test/hg-050`),
or as a number after an @ (`test/hg@0.5`). What stands before is the scenario; the split `std` of the same folder
is severity 0 of each, and a split of the scenario's own name (`test/hg`) severity 1. Every other split stands by
itself.
"""

import re
from collections.abc import Iterable

Ladders = dict[str, list[tuple[float, str]]]

_RUNG = re.compile(r"(?P<scenario>.*[^/])(-(?P<hundredths>\d{3})|@(?P<severity>\d+(\.\d+)?))")


def find_ladders(splits: Iterable[str]) -> Ladders:
    """Finds the ladders of shifts among splits by their names.

    Args:
        splits: names of splits.

    Returns:
        By scenario, its rungs as (severity, split), ascending, with `std` at severity 0 and the scenario itself at 1
        where they are there; scenarios with fewer than two rungs are left out.
    """
    splits = list(splits)
    ladders: Ladders = {}
    for split in splits:
        if named := _RUNG.fullmatch(split):
            hundredths = named["hundredths"]
            severity = int(hundredths) / 100 if hundredths else float(named["severity"])
            ladders.setdefault(named["scenario"], []).append((severity, split))
    for scenario, rungs in ladders.items():
        folder, slash, _ = scenario.rpartition("/")
        if f"{folder}{slash}std" in splits and all(severity > 0 for severity, _ in rungs):
            rungs.append((0.0, f"{folder}{slash}std"))
        if scenario in splits and all(severity != 1 for severity, _ in rungs):
            rungs.append((1.0, scenario))
        rungs.sort()
    return {scenario: rungs for scenario, rungs in ladders.items() if len(rungs) > 1}
