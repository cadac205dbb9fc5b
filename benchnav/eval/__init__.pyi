from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.report.write import read_report, write_report
from benchnav.eval.run.runner import run_suite

__all__ = [
    "Condition",
    "Suite",
    "compare_runs",
    "open_run",
    "read_report",
    "read_steps",
    "run_suite",
    "write_report",
]
