"""Maps of a study and runs of its parts."""

import contextlib
import hashlib
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from matplotlib.figure import Figure

from benchnav.core.errors import expect
from benchnav.core.store import replacing, write_text
from benchnav.core.tables import Table, to_markdown
from benchnav.datagen import TerrainDataset
from benchnav.eval.run.unit import one_thread
from benchnav.viz.style import save
from studies.study import ROOT, Study, Work

DEVELOPED_MAPS = 200


def command(program: str, *words: object) -> None:
    """Run a command of the package from the root, to which paths of parts are relative.

    If the command fails, exit with its status.
    """
    started = time.perf_counter()
    if code := subprocess.run(
        [Path(sys.executable).with_name(program), *map(str, words)], cwd=ROOT
    ).returncode:
        sys.exit(code)  # the command has printed its error
    print(
        f"-- {program} {' '.join(map(str, words[:3]))}: "
        f"{time.perf_counter() - started:.0f} s",
        flush=True,
    )


def make_maps(study: Study, work: Work) -> None:
    """Create the missing maps, and check the digests of all.

    Raises:
        ConfigError: If a digest differs from that of the study.
    """
    work.maps_in.mkdir(parents=True, exist_ok=True)
    for name, maps in study.maps.items():
        path = work.maps_in / f"{name}.h5"
        if not path.exists():
            splits = f"[{','.join(maps.splits)}]"
            command(
                "benchnav-datagen",
                "create",
                *maps.create,
                "--splits",
                splits,
                "--out",
                path,
            )
        digest = TerrainDataset(path).splits[maps.splits[0]]["digest"]
        expect(
            digest == (maps.digest or digest),
            f"maps of digest {maps.digest} in {path}, got {digest}. Delete the file, "
            "or use another `--maps_in`.",
        )
        print(f"{name}: {digest}")


def run(study: Study, parts: list[str], work: Work) -> None:
    """Run parts in this order."""
    for part in parts:
        if study.parts[part].script:
            _run_script(study, part, work)
        else:
            drive(study.suite(part, work), work.out / study.run_of(part), work.jobs)


def drive(suite: dict[str, Any], folder: Path, jobs: int) -> None:
    """Run the units of a suite that are missing in a folder."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    config = folder.with_name(f"{folder.name}.yaml")
    config.write_text(yaml.safe_dump(suite, sort_keys=False, allow_unicode=True))
    command("benchnav-eval", "run", "--config", config, "--out", folder, "--jobs", jobs)


def _run_script(study: Study, part: str, work: Work) -> None:
    """Call a part's script; store results as NAME.png, NAME.md or NAME.md and NAME.csv."""
    folder, settings = work.out / study.run_of(part), study.parts[part]
    folder.mkdir(parents=True, exist_ok=True)
    options = {**settings.options, **({"maps": work.maps} if work.maps else {})}
    # Paths of shipped maps and models are relative to the root.
    with contextlib.chdir(ROOT), one_thread():
        results = study.function(settings.script)(work, folder, **options)
    for name, result in results.items():
        path = folder / name
        if isinstance(result, Figure):
            with replacing(path.with_suffix(".png")) as partial:
                save(result, partial, "png", dpi=200)
            continue
        text = result
        if not isinstance(result, str):
            rows = pd.DataFrame(result)
            write_text(path.with_suffix(".csv"), rows.to_csv(index=False))
            text = to_markdown(table_of(rows))
        write_text(path.with_suffix(".md"), text)
        print(f"{name}\n{text}", flush=True)


def table_of(rows: pd.DataFrame) -> Table:
    """Return rows as a table, with floats of four significant digits."""
    cells = rows.map(
        lambda value: f"{value:.4g}" if isinstance(value, float) else str(value)
    )
    return Table(
        headings=tuple(map(str, rows.columns)),
        rows=tuple(cells.itertuples(index=False, name=None)),
    )


def develop(study: Study, work: Work) -> None:
    """Run the conditions of the hypotheses on the study's development maps.

    Raises:
        ConfigError: If the study has no development maps.
    """
    expect(
        study.develop,
        f"a study with development maps (`develop`), got {study.name}. Name them in "
        "its study.yaml.",
    )
    suite = study.suite("primary", work)
    changes = {
        "data": str(work.maps_in / f"{study.develop}.h5"),
        "seed": study.seed,
        "maps": min(DEVELOPED_MAPS, suite["maps"]),
    }
    drive(suite | changes, developed(study, work), work.jobs)


def developed(study: Study, work: Work) -> Path:
    """Return the folder of the run on the development maps."""
    return work.out / f"{study.name}-developed"


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
