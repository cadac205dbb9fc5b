"""What `run.json` and the table of episodes have to hold: the one place that says so, wherever they are read.

`run.json` ends in a seal, the digest of all else in it, and holds the digests of the run's tables, so that an edit of
either is found. What was written without a seal is checked by its types, its ids and its counts alone.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.hypotheses import DIRECTIONS, KINDS, METRICS, digest_of_tests
from benchnav.eval.trial import LABELS
from benchnav.planning.world.outcome import Outcome

SEAL = "seal"
KEYS = ["trial", "seed", "realisation", "instance"]


class DamageError(ValueError):
    """A file of a run does not hold what it has to."""


@dataclass(frozen=True)
class _Each:
    """A mapping from any text, or a list, of one kind of value."""

    kind: Any
    of: type = dict


_PART = {"part": str, "options": dict}
_PARTS = dict.fromkeys(("model", "risk", "planner", "robot", "objective"), _PART)
_NOISE = {"noise": str}
# Of a mapping the keys that it has to have; `?` marks those that earlier versions, or some runs, do not write.
_VALUE = {
    "data": str,
    "split": str,
    **_PARTS,
    "rules": {"free_space": {"by": str, "above": float}},
    "world": _NOISE,
}
_TRIAL = {
    "value": _VALUE,
    "labels": dict.fromkeys(LABELS, str),
    "seeds": _Each(int, list),
    "draws": _Each(_Each(int, list), list),
    "follows?": str,
    "remarks?": _Each(str, list),
    "changed?": _Each(str, list),
    "latency?": {"median_ms": float, "p95_ms": float, "max_ms": float, "steps": int},
}
_TEST = {
    **dict.fromkeys(("one", "other", "metric", "kind", "direction", "claim"), str),
    "names": _Each(str, list),
    "margin": float,
}
_DATASET = {"id?": str, "maps": _Each(_Each(str, list))}
_ENTRY = {"command": str, "date": str, "suite": dict}
_CODE = {"sources": str, "versions?": _Each(str), "processor?": str, "compiles?": bool}
_EARLIER = {
    "run_id": str,
    "suite": dict,
    "trials": _Each(_TRIAL),
    "datasets?": _Each(_DATASET),
    "code?": _CODE,
    "parts?": dict,
    "commands?": _Each(str, list),
    "machine?": dict,
    "shard?": {"index": int, "of": int},
    "device?": str,
    "planner_limit_s?": float,
    "warnings?": _Each(str, list),
    "dropped?": _Each({"planner": str, "robot": str, "reason": str}, list),
    "hypotheses?": {"tests": _Each(_TEST, list), "digest": str, "episodes": _Each(int)},
    "tables?": _Each(str),
    "history?": _Each(_ENTRY, list),
}
_NEEDED = ("datasets", "code", "parts", "commands", "machine", "device", "planner_limit_s")
_CURRENT = {
    name.removesuffix("?") if name[:-1] in _NEEDED else name: kind for name, kind in _EARLIER.items()
} | {
    "code": {name.removesuffix("?"): kind for name, kind in _CODE.items()},
    "datasets": _Each({**_DATASET, "id": str}),
}
_VERSION_1 = {
    "suite": {
        "model": str,
        "seed": int,
        "noise": str,
        "time_budget_s": float,
        "planner_options": _Each(dict),
    },
    "dataset": {"id": str},
    "command": str,
}

_NUMBERS = (
    *("total_time_s", "end_time_s", "traversability", "time_ratio", "path_length_m", "stuck_share"),
    *("reference_time_s", "planning_ms"),
)
_COLUMNS_1 = {
    **dict.fromkeys(("planner", "risk", "scenario", "outcome"), "text"),
    **dict.fromkeys((*_NUMBERS[:-1], "roughness"), "number"),
    "instance": "whole",
    "success": "bool",
}
_COLUMNS = {
    **dict.fromkeys(("trial", *LABELS, "outcome", "error"), "text"),
    **dict.fromkeys(("seed", "realisation", "instance"), "whole"),
    **dict.fromkeys((*_NUMBERS, "score", "roughness_radps2"), "number"),
    "success": "bool",
    "compiled": "bool",
}
# Those that earlier versions did not write.
_LATER = {
    **dict.fromkeys(("group", "redrawn"), "whole"),
    **dict.fromkeys(("planning_ms_p95", "planning_start_ms"), "number"),
}
_OUTCOMES = {outcome.name.lower() for outcome in Outcome if outcome != Outcome.RUNNING}


def seal(about: Mapping[str, Any]) -> dict[str, Any]:
    """Gives what `run.json` is to hold, with the digest of all of it."""
    content = {name: value for name, value in about.items() if name != SEAL}
    return {**content, SEAL: _digest(content)}


def check_about(about: Any, version: int) -> None:
    """Refuses a `run.json` that is not as benchnav writes it.

    Args:
        about: what it holds.
        version: of its format.

    Raises:
        DamageError: something is missing, of another type, or does not fit the rest.
    """
    kind = {1: _VERSION_1, 2: _EARLIER}.get(version, _CURRENT)
    _check(about, kind, "")
    if SEAL in about and seal(about)[SEAL] != about[SEAL]:
        raise DamageError("it was changed after benchnav wrote it")
    if version == 1:
        return
    if not about["trials"]:
        raise DamageError("it names no trial")
    for trial_id, entry in about["trials"].items():
        draws = entry["draws"]
        if not draws or any(len(draw) != 3 or draw[1] < 0 or draw[2] < 1 for draw in draws):
            raise DamageError(f"trial {trial_id} has draws that are none")
        if len({(seed, realisation) for seed, realisation, _ in draws}) < len(draws):
            raise DamageError(f"trial {trial_id} has a draw twice")
        if set(entry["seeds"]) != {seed for seed, _, _ in draws}:
            raise DamageError(f"trial {trial_id} has seeds that are not those of its draws")
        if version > 2:
            _check_value(trial_id, entry, about["datasets"])
    if "hypotheses" in about:
        _check_hypotheses(about["hypotheses"], about["trials"])


def _check_hypotheses(about: Mapping[str, Any], trials: Mapping[str, Any]) -> None:
    """Refuses hypotheses that cannot be tested, or that their digest is not of."""
    for test in about["tests"]:
        known = {
            "metric": METRICS,
            "kind": KINDS,
            "direction": ("", *DIRECTIONS),
            "one": trials,
            "other": trials,
        }
        for name, values in known.items():
            if test[name] not in values:
                raise DamageError(f"a hypothesis has {name} {test[name]!r}, which there is none of")
    if digest_of_tests(about["tests"]) != about["digest"]:
        raise DamageError("its hypotheses are not those of their digest")


def _check_value(trial_id: str, entry: Mapping[str, Any], datasets: Mapping[str, Any]) -> None:
    """Refuses a trial that its id is not the digest of, or that has more instances than there are maps."""
    value = entry["value"]
    if _digest(value)[:16] != trial_id:
        raise DamageError(f"trial {trial_id} has a value that is not its own")
    if (entry["labels"]["data"], f"test/{entry['labels']['scenario']}") != (value["data"], value["split"]):
        raise DamageError(f"trial {trial_id} has labels that are not its own")
    maps = datasets.get(value["data"], {"maps": {}})["maps"].get(value["split"], [])
    if max(instances for _, _, instances in entry["draws"]) > len(maps):
        raise DamageError(f"trial {trial_id} has more instances than the {len(maps)} maps that the run knows")


def check_table(path: Path, about: Mapping[str, Any]) -> None:
    """Refuses a table that is not, byte by byte, the one that the run wrote; runs of before that do not say.

    Raises:
        DamageError: it is another.
    """
    known = about.get("tables", {}).get(path.name)
    if known not in (None, digest_of_file(path)):
        raise DamageError("it was changed after benchnav wrote it")


def digest_of_file(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_rows(rows: pd.DataFrame, about: Mapping[str, Any], version: int) -> None:
    """Refuses rows of episodes that are not those of a finished run.

    Args:
        rows: the table.
        about: the `run.json` beside it, which was checked.
        version: of its format.

    Raises:
        DamageError: a column is missing or of another type, a row is there twice, missing or of another run, or an
            outcome or time is none.
    """
    needed = _COLUMNS_1 if version == 1 else _COLUMNS
    for name, kind in (needed | _LATER).items():
        if (name in needed and name not in rows) or (name in rows and not _is(kind, rows[name])):
            raise DamageError(f"it has no column {name} of {_WORDS[kind]}")
    if rows.empty:
        raise DamageError("it has no rows")
    unknown = set(rows["outcome"]) - _OUTCOMES
    if unknown:
        raise DamageError(f"{min(unknown)!r} is no outcome")
    if ((rows["outcome"] == "success") != rows["success"]).any():
        raise DamageError("its columns outcome and success do not agree")
    times = rows[["total_time_s", "end_time_s"]].to_numpy()
    if not np.isfinite(times).all() or (times < 0).any():
        raise DamageError("it has times that are none")
    if version > 1:
        _check_episodes(rows, about["trials"])


def _check_episodes(rows: pd.DataFrame, trials: Mapping[str, Any]) -> None:
    """Compares rows with what the run says that it has: each episode of each trial once, under its labels."""
    expected = sum(instances for entry in trials.values() for _, _, instances in entry["draws"])
    if len(rows) != expected:
        raise DamageError(f"it has {len(rows)} rows, where the run has {expected} episodes")
    known = pd.MultiIndex.from_tuples(
        (trial_id, seed, realisation, instance)
        for trial_id, entry in trials.items()
        for seed, realisation, instances in entry["draws"]
        for instance in range(instances)
    )
    found = pd.MultiIndex.from_frame(rows[KEYS])
    if found.has_duplicates:
        raise DamageError("it has an episode twice")
    if not found.isin(known).all():
        raise DamageError("it has episodes that the run has not")
    for name in LABELS:
        labels = {trial_id: entry["labels"][name] for trial_id, entry in trials.items()}
        if (rows["trial"].map(labels) != rows[name]).any():
            raise DamageError(f"its column {name} does not hold the labels of the run")


_WORDS = {"text": "text", "whole": "whole numbers", "number": "numbers", "bool": "true and false"}


def _is(kind: str, column: pd.Series) -> bool:
    if kind == "text":
        return column.map(lambda value: isinstance(value, str)).all()
    types = pd.api.types
    if kind == "bool":
        return types.is_bool_dtype(column) and not column.isna().any()
    if kind == "whole":
        return types.is_integer_dtype(column) and not column.isna().any()
    return types.is_numeric_dtype(column) and not types.is_bool_dtype(column)


def _digest(content: Mapping[str, Any]) -> str:
    # As in `Trial.id`.
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _check(value: Any, kind: Any, place: str) -> None:
    """Compares plain data with a kind: a type, a mapping of kinds by key, or `_Each`."""
    named = place or "what it holds"
    if isinstance(kind, _Each):
        _check(value, kind.of, place)
        inner = value.items() if kind.of is dict else enumerate(value)
        for name, item in inner:
            _check(item, kind.kind, f"{place}.{name}".removeprefix("."))
    elif isinstance(kind, Mapping):
        _check(value, dict, place)
        for key, item in kind.items():
            name = key.removesuffix("?")
            if name in value:
                _check(value[name], item, f"{place}.{name}".removeprefix("."))
            elif name == key:
                raise DamageError(f"{named} lacks {name!r}")
    elif kind is float:
        if type(value) not in (int, float):
            raise DamageError(f"{named} is no number")
    elif type(value) is not kind:
        raise DamageError(f"{named} is no {_JSON[kind]}")


_JSON = {int: "whole number", str: "text", bool: "true or false", dict: "mapping", list: "list"}
