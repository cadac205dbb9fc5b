"""Suites of the studies, read as they are run."""

from pathlib import Path

from benchnav.core.settings import of, read
from benchnav.eval import Condition, Suite
from benchnav.eval.experiment.condition import conditions_of
from studies.study import ROOT, Study, Work

WORK = Work(out=Path("runs"), maps_in=Path("maps"))


def suite(study: str, part: str) -> Suite:
    """Return the suite of a part."""
    made: Suite = read(Suite, Study.load(study).suite(part, WORK), of("the suite"))
    return made


def conditions(study: str, part: str) -> list[Condition]:
    """Return the conditions of a part, with parts of files by their paths from the
    root.
    """
    import contextlib

    with contextlib.chdir(ROOT):
        return conditions_of(suite(study, part), lambda data: ["std", "hg", "hs"])
