from benchnav.eval.compare import compare_runs as compare_runs
from benchnav.eval.experiment.condition import Condition as Condition
from benchnav.eval.experiment.suite import Suite as Suite
from benchnav.eval.folder.folder import open_run as open_run
from benchnav.eval.folder.steps import read_steps as read_steps
from benchnav.eval.report.write import read_report as read_report
from benchnav.eval.report.write import write_report as write_report
from benchnav.eval.run.runner import run_suite as run_suite
