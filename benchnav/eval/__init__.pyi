from benchnav.eval.between import Between
from benchnav.eval.compare import compare_runs
from benchnav.eval.evaluation import evaluate
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.report.write import read_report, write_report
from benchnav.eval.results import Comparison, Results
from benchnav.eval.results import open_results as open_run
from benchnav.eval.run.runner import run_suite

__all__ = [
    "Between",
    "Comparison",
    "Condition",
    "Results",
    "Suite",
    "compare_runs",
    "evaluate",
    "open_run",
    "read_report",
    "read_steps",
    "run_suite",
    "write_report",
]
