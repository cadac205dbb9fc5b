"""Repeat a study of the documentation, from its maps to the tables and figures of its
page.

    python -m studies knowledge                    # maps, runs, report
    python -m studies knowledge maps               # create missing maps; check the digests of all
    python -m studies knowledge develop            # run the hypotheses on development maps; print their power
    python -m studies knowledge power
    python -m studies knowledge run primary known  # resumes if it was interrupted
    python -m studies knowledge report             # write tables and figures of the page
    python -m studies knowledge keep               # copy rows of finished runs into the study's folder

Maps are stored in the folder `--maps_in`, runs in the folder `--out`. With `--maps N`
only the first N maps are run.
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
        "study", help=f"{', '.join(names)}; or a folder that has a study.yaml"
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
        "--maps", type=int, default=0, help="number of maps; if 0, that of the suites"
    )
    parser.add_argument("--jobs", type=int, default=2, help="number of processes")
    arguments = parser.parse_args(words)
    try:
        study = Study.load(arguments.study)
        work = Work(
            out=arguments.out.resolve(),
            maps_in=arguments.maps_in.resolve(),
            maps=arguments.maps,
            jobs=arguments.jobs,
        )
        _do(arguments.what, study, study.choose(arguments.parts), work)
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
