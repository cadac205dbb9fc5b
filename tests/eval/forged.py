"""Runs that were made or changed by hand and yet sealed, as if benchnav had written
them so.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.eval.folder.provenance import code_digest
from benchnav.eval.folder.run_folder import (
    EPISODES,
    FORMAT_VERSION,
    open_run,
    write_run,
)
from benchnav.eval.folder.sealed import with_metadata

CODE: dict[str, dict[str, Any]] = {
    "modules": {"benchnav.eval.run.unit": "s"},
    "environment": {
        "torch": "2.1", "processor": "AVX2", "compiles": True, "device": "cpu", "planner_limit_s": 0.0,
    },
    "parts": {},
}  # fmt: skip


def code_with(**changes: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """`CODE` with other entries in its groups."""
    return {group: {**known, **changes.get(group, {})} for group, known in CODE.items()}


def forge_rows(folder: Path, rows: pd.DataFrame) -> None:
    """Replaces the table of a run; success follows the outcome."""
    _write_rows(
        folder,
        rows.assign(success=rows["outcome"] == "success"),
        open_run(folder).manifest,
    )


def forge_run(
    folder: Path,
    rows: pd.DataFrame,
    conditions: Mapping[str, Mapping[str, Any]],
    **changes: Any,
) -> Path:
    """Makes a finished run of a table by one code.

    `conditions` are as `run.json` has them, and `changes` other keys, or `code`, which
    made the rows.
    """
    code = changes.pop("code", CODE)
    digest = code_digest(code)
    notes: dict[str, Any] = {"follows": "", "remarks": [], "changed": []}
    about: dict[str, Any] = {
        "format": "benchnav-run", "format_version": FORMAT_VERSION, "suite": {},
        "conditions": {name: notes | dict(entry) for name, entry in conditions.items()}, "datasets": {},
        "codes": {digest: code}, "reused": "",
        "planner_limit_s": 0.0, "device": "cpu", "gpu": None, "warnings": [], "dropped": [],
        "history": [], "machine": {"processor": "AMD", "cores": 2, "host": "here"},
    }  # fmt: skip
    folder.mkdir(parents=True)
    _write_rows(
        folder, rows.assign(code=digest), json.loads(json.dumps(about | changes))
    )
    return folder


def _write_rows(folder: Path, rows: pd.DataFrame, about: Mapping[str, Any]) -> None:
    rows.to_parquet(folder / EPISODES)
    digest = hashlib.sha256((folder / EPISODES).read_bytes()).hexdigest()
    write_run(folder, {**about, "tables": {EPISODES: digest}})


def forge_steps(path: Path, steps: pd.DataFrame) -> None:
    """Writes a file of steps by hand, sealed as those of a run are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        with_metadata(
            pa.Table.from_pandas(steps, preserve_index=False), {"key": "forged"}
        ),
        path,
    )
