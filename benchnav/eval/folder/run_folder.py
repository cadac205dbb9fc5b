"""Run folders, format version 6: what lies where, and how it is read.

A run folder holds `run.json` (conditions, and where everything came from), `units/`
(what is finished: one Parquet file a unit, by condition and key, with rows and, in its
metadata, what else is known of it), `steps/`, `playback/`, and, when all is done,
`episodes.parquet`, `errors.txt` where a planner, model, sensor or belief failed, and
the report. Every file is written under another name first. `run.json` is sealed, and
holds the digests of the run's tables, so that an edit of either is found.
"""

import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import ConfigError, out_of_memory
from benchnav.core.settings import one_line
from benchnav.core.sources import digest_of_path
from benchnav.core.store import Shard, replacing, seal, unseal, write_text
from benchnav.eval.experiment.condition import NOT_USED, Condition, condition_from
from benchnav.eval.experiment.suite import RECORDS
from benchnav.eval.experiment.unit import DRAW, Extent, Unit, steps_path
from benchnav.eval.folder.provenance import (
    METRICS,
    TOUCHED,
    Origin,
    code_digest,
    touches,
)
from benchnav.eval.folder.sealed import (
    CONTENT,
    DamageError,
    damage_of,
    metadata,
    read_sealed,
    with_metadata,
)

FORMAT, FORMAT_VERSION = "benchnav-run", 6
RUN, EPISODES, ERRORS = "run.json", "episodes.parquet", "errors.txt"
KEYS = ["condition", *DRAW]  # of a row


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder that was found.

    Args:
        folder: where.
        about: all of `run.json`.
        conditions: by id, with how often each is run.
        shard: which shard of the run the folder holds; None where it holds all.
    """

    folder: Path
    about: dict[str, Any]
    conditions: dict[str, tuple[Condition, Extent]]
    shard: Shard | None = None


def open_run(folder: Path) -> Run:
    """Reads what a run folder is about.

    Raises:
        ConfigError: the folder is no run folder, or of another format version.
    """
    if not (folder / RUN).is_file():
        raise ConfigError(
            f"Expected a run folder with {RUN}, got {folder}. Make one with "
            "`benchnav-eval run`."
        )
    with damaged(
        folder / RUN, "Take it from a copy, or run the suite again into another folder."
    ):
        text = (folder / RUN).read_text()
        version = _format_version(json.loads(text))
        if version == FORMAT_VERSION:
            about = unseal(text)
            conditions = {
                i: (
                    condition_from(entry),
                    Extent(draws=tuple(tuple(draw) for draw in entry["draws"])),
                )
                for i, entry in about["conditions"].items()
            }
            shard = Shard(**about["shard"]) if "shard" in about else None
            return Run(folder=folder, about=about, conditions=conditions, shard=shard)
    remedy = "Read it with a newer benchnav: pip install --upgrade benchnav"
    if version < FORMAT_VERSION:
        remedy = "Run its suite again, or read it with benchnav 1.3"
    raise ConfigError(
        f"Expected a run folder of format version {FORMAT_VERSION}, got {folder} of "
        f"version {version}. {remedy}."
    )


def _format_version(about: Any) -> int:
    """Return the format version of `run.json`."""
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise DamageError("it does not say that it is a run")
    return int(about["format_version"])


def is_taken(folder: Path) -> bool:
    """Whether a place holds anything, so that no new run can be begun there."""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def write_run(folder: Path, about: Mapping[str, Any]) -> None:
    """Writes `run.json`."""
    write_text(folder / RUN, seal(about))


def caveats(about: Mapping[str, Any]) -> list[str]:
    """What readers of a run's tables should know: its warnings, and the combinations
    that it left out.

    Args:
        about: of its `run.json` at least `warnings` and `dropped`.
    """
    left_out = [f"left out: {_in_words(entry)}" for entry in about["dropped"]]
    warnings = [*about["warnings"], *([about["reused"]] if about.get("reused") else [])]
    return [*(f"warning: {line}" for line in warnings), *left_out]


def dropped_labels(entry: Mapping[str, str]) -> dict[str, str]:
    """The labels that do not go together, by column, of an entry of `dropped`."""
    return {column: label for column, label in entry.items() if column != "reason"}


def _in_words(entry: Mapping[str, str]) -> str:
    """Return a combination that was left out, and why, in words."""
    labels = dropped_labels(entry).items()
    words = ", ".join(
        f"{column} {label}" for column, label in labels if label != NOT_USED
    )
    return f"{words}: {entry['reason']}"


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Reads a table of episodes of a finished run, which is checked against `run.json`.

    Raises:
        ConfigError: the run is not finished, the folder holds a shard of it, or the
            table is not the run's.
    """
    path, run = folder / name, open_run(folder)
    if not path.exists():
        if run.shard is not None:
            raise ConfigError(
                f"Expected a whole run, got {folder}, which is shard {run.shard} of a "
                "run and has no tables. Merge all "
                "shards with `benchnav-eval merge OUT PART …`."
            )
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. Give its "
            "`benchnav-eval run` command again to "
            "finish it; `benchnav-eval report --partial` and `replay` read what is "
            "there."
        )
    with damaged(path, "Remove it and give the run's command again."):
        if run.about.get("tables", {}).get(name) != digest_of_path(path):
            raise DamageError("it was changed after benchnav wrote it")
        return pd.read_parquet(path)


@contextmanager
def damaged(path: Path, remedy: str) -> Iterator[None]:
    """Says in one line that a file is not what it has to be, whatever reading it
    raised.
    """
    try:
        yield
    except PermissionError:
        raise
    except (
        Exception
    ) as error:  # of a table what its library raises, of a rule what refuses a suite
        said = (
            error if isinstance(error, DamageError | ConfigError) else one_line(error)
        )
        raise out_of_memory(error) or ConfigError(
            f"{path} is damaged: {said}. {remedy}"
        ) from error


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A finished unit in a run folder.

    Args:
        path: its file.
        about: the metadata of the file: `unit` (what was run), `key`, `code`, `digests`
            of the maps, `record`, `made` (a token of this one making of it, which
            copies keep), `traceback`, `errors`, `touched` by the user's own parts, and
            the digests `content` of its rows, `steps` of its steps and `recordings` of
            its recordings by their path.
    """

    path: Path
    about: Mapping[str, Any]

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.path.parents[2]

    @property
    def metrics(self) -> set[str]:
        """Columns of its rows besides those that every run has."""
        return set(self.about["code"].get(METRICS, ()))

    def has(self, unit: Unit) -> bool:
        """Whether it was recorded as a unit is now to be, and what was recorded is
        still of its making.
        """
        if RECORDS.index(self.about["record"]) < RECORDS.index(unit.record):
            return False
        steps = self.folder / unit.steps_path
        return (
            self.about["record"] == "none"
            or metadata(steps).get("key") == self.about["key"]
        )

    def damage(self) -> list[str]:
        """Return what of the unit is not as it was written, a line each that begins
        with the file.

        Steps and recordings count if they are of this making of the unit; a file that
        is missing is no damage.
        """
        lines = damage_of(self.path, str(self.path.relative_to(self.folder)))
        steps = steps_path(self.about["unit"][0], self.path.name.rpartition("-")[0])
        about = metadata(self.folder / steps)
        if about and about.get("key") != self.about["key"]:
            return lines
        if self.about.get("steps") and (self.folder / steps).exists():
            of_others = [f"{steps}: it holds the steps of another run"]
            is_own = about.get(CONTENT) == self.about["steps"]
            lines += damage_of(self.folder / steps, str(steps)) or (
                [] if is_own else of_others
            )
        for name, digest in self.about.get("recordings", {}).items():
            if digest_of_path(self.folder / name) not in ("", digest):
                lines.append(f"{name}: it was changed after benchnav wrote it")
        return lines


def find_units(folder: Path, unit: Unit) -> list[Finished]:
    """Finds all makings of a unit, of whatever code and maps, the newest first."""
    files = sorted(
        (folder / "units" / unit.condition.id).glob(f"{unit.name}-*.parquet"),
        key=lambda path: path.stat().st_mtime,
        reverse=True,
    )
    found = [Finished(path=path, about=metadata(path)) for path in files]
    return [
        finished for finished in found if finished.about.get("unit") == _identity(unit)
    ]


def unit_path(unit: Unit, key: str) -> Path:
    """Return where a unit that is made under a key lies in a run folder."""
    return Path("units", unit.condition.id, f"{unit.name}-{key}.parquet")


def _identity(unit: Unit) -> list[Any]:
    return [unit.condition.id, unit.seed, unit.realisation, *unit.maps]


def write_unit(
    folder: Path,
    unit: Unit,
    origin: Origin,
    rows: pd.DataFrame,
    errors: Sequence[str],
    traceback: str,
) -> None:
    """Writes a finished unit.

    Args:
        folder: the run folder.
        unit: what was run.
        origin: of its rows.
        rows: a row an episode.
        errors: what went wrong, a line each.
        traceback: of the first of them.
    """
    key = origin.key(unit)
    recordings = [unit.recording_path(member) for member in range(len(unit.maps))]
    about = {
        "unit": _identity(unit),
        "key": key,
        "code": origin.code,
        "digests": list(origin.maps),
        "record": unit.record,
        "made": secrets.token_hex(8),
        "traceback": traceback,
        "errors": list(errors),
        TOUCHED: touches(unit.condition, unit.metrics),
        "steps": metadata(folder / unit.steps_path).get(CONTENT, ""),
        "recordings": {
            path.as_posix(): digest
            for path in recordings
            if (digest := digest_of_path(folder / path))
        },
    }
    table = pa.Table.from_pandas(
        rows.assign(code=code_digest(origin.code)), preserve_index=False
    )
    with replacing(folder / unit_path(unit, key)) as partial:
        pq.write_table(with_metadata(table, about), partial)


def clear_unit(folder: Path, unit: Unit) -> None:
    """Removes steps and recordings of an earlier making of a unit; its rows stay."""
    (folder / unit.steps_path).unlink(missing_ok=True)
    for member in range(len(unit.maps)):
        for suffix in (".npz", ".rrd"):
            (folder / unit.recording_path(member, suffix)).unlink(missing_ok=True)


def finish_run(
    folder: Path, finished: Sequence[tuple[Unit, Finished]], reused: str = ""
) -> None:
    """Writes `episodes.parquet` of all units, its digest and codes into `run.json`, and
    `errors.txt`.

    Args:
        folder: the run folder.
        finished: all units of the run, in the order of the table.
        reused: a line on units that other code has made; empty where there are none.
    """
    about = open_run(folder).about
    write_errors(folder, finished)
    rows = pd.concat(
        [labelled_rows(unit, one) for unit, one in finished], ignore_index=True
    )
    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(
        None
    )
    with replacing(folder / EPISODES) as partial:
        pq.write_table(table, partial)
    codes: dict[str, Any] = {}
    for _, one in finished:
        code = codes.setdefault(
            code_digest(one.about["code"]), {**one.about["code"], TOUCHED: {}}
        )
        code[TOUCHED] |= one.about.get(TOUCHED, {})
    known = {
        "codes": codes,
        "reused": reused,
        "tables": {EPISODES: digest_of_path(folder / EPISODES)},
    }
    if {name: about.get(name) for name in known} != known:
        write_run(folder, {**about, **known})


def write_errors(folder: Path, finished: Iterable[tuple[Unit, Finished]]) -> None:
    """Writes `errors.txt` of all units, or removes it where nothing failed."""
    traces = [text for unit, one in finished if (text := _trace(unit, one, folder))]
    if traces:
        write_text(folder / ERRORS, "\n".join(traces))
    else:
        (folder / ERRORS).unlink(missing_ok=True)


def unit_rows(finished: Finished) -> pd.DataFrame:
    """Read the rows of a finished unit.

    Raises:
        ConfigError: If its file is damaged.
    """
    with damaged(
        finished.path, "Give the run's command again, which runs the unit again."
    ):
        return read_sealed(finished.path).to_pandas()


def labelled_rows(unit: Unit, finished: Finished) -> pd.DataFrame:
    """Reads the rows of a finished unit, under the labels that its condition has now;
    see `unit_rows`.
    """
    return unit_rows(finished).assign(**unit.condition.labels)


def differences(
    first: pd.DataFrame, second: pd.DataFrame
) -> tuple[pd.DataFrame, pd.Index]:
    """What differs between two tables of episodes, bit for bit, in columns of results
    that both have.

    Args:
        first: rows of episodes, in any order.
        second: as well.

    Returns:
        The cells that differ, in the order of the first: `first`, `second`, by `KEYS`
        and the column's name. And the keys of episodes that one of the tables lacks.
    """
    common = _results(first) & _results(second)
    one, other = (
        rows.set_index(KEYS)[sorted(common, key=list(first).index)]
        for rows in (first, second)
    )
    both = one.index.intersection(other.index, sort=False)
    cells = one.loc[both].compare(other.loc[both], result_names=("first", "second"))
    lacking = one.index.symmetric_difference(other.index, sort=False)
    cells = cells.stack(level=0, future_stack=True).dropna(how="all")
    return cells.reindex(columns=["first", "second"]), lacking


def differing_columns(first: pd.DataFrame, second: pd.DataFrame) -> list[str]:
    """Columns of results that only one of two tables has."""
    return sorted(_results(first) ^ _results(second))


def _results(rows: pd.DataFrame) -> set[str]:
    """Columns of results: no wall times, and not the digest of the code."""
    others = (*KEYS, "code", "learning_ms")
    return {
        name for name in rows if name not in others and not name.startswith("planning_")
    }


def _trace(unit: Unit, finished: Finished, folder: Path) -> str:
    about = finished.about
    if not about["traceback"] and not about["errors"]:
        return ""
    maps = f"maps {unit.maps[0]}–{unit.maps[-1]}"
    place = finished.path.relative_to(folder)
    heading = (
        f"{unit.condition.description}, seed {unit.seed}, realisation "
        f"{unit.realisation}, {maps} ({place})"
    )
    return "\n".join([heading, *about["errors"], about["traceback"]])
