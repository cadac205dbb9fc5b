"""Repeat a study of the documentation, from its maps to the tables and figures of its
page.

    python -m studies knowledge                    # maps, runs, report
    python -m studies knowledge maps               # make the maps, or check the digests of those there
    python -m studies knowledge develop            # the hypotheses on maps to develop on; then their power
    python -m studies knowledge power
    python -m studies knowledge run primary known  # resumes if it was interrupted
    python -m studies knowledge report             # tables and figures of the page
    python -m studies knowledge keep               # summaries and rows of finished runs into the study's folder

Maps and runs lie in the folders `--maps_in` and `--out`. With `--maps` only the first
maps are driven.
"""

import argparse
import sys
from pathlib import Path

from benchnav import BenchnavError
from studies import page, rows, runs
from studies.power import power
from studies.study import HOME, Study, Work

_WHATS = ("all", "maps", "develop", "power", "run", "report", "keep")


def main(words: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m studies",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = sorted(path.parent.name for path in HOME.glob("*/study.yaml"))
    parser.add_argument(
        "study", help=f"{', '.join(names)}; or a folder with a study.yaml"
    )
    parser.add_argument("what", nargs="?", choices=_WHATS, default="all")
    parser.add_argument("parts", nargs="*", help="parts of the study; if empty, all")
    parser.add_argument(
        "--out", type=Path, default=Path("runs"), help="folder of the runs"
    )
    parser.add_argument(
        "--maps_in", type=Path, default=Path("datasets"), help="folder of the maps"
    )
    parser.add_argument(
        "--maps", type=int, default=0, help="number of maps; if 0, as the suites say"
    )
    parser.add_argument("--jobs", type=int, default=2, help="number of processes")
    given = parser.parse_args(words)
    try:
        study = Study.load(given.study)
        work = Work(
            out=given.out.resolve(),
            maps_in=given.maps_in.resolve(),
            maps=given.maps,
            jobs=given.jobs,
        )
        _do(given.what, study, study.choose(given.parts), work)
    except BenchnavError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return error.status
    return 0


def _do(what: str, study: Study, parts: list[str], work: Work) -> None:
    if what in ("all", "maps"):
        runs.make_maps(study, work)
    if what in ("all", "run"):
        runs.run(study, parts, work)
    if what in ("all", "report"):
        page.report(study, work)
    if what == "develop":
        runs.develop(study, work)
    if what in ("develop", "power"):
        print(power(study, work))
    if what == "keep":
        rows.keep(study, parts, work)


if __name__ == "__main__":
    sys.exit(main())
