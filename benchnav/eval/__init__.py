"""Evaluation: experiments, running them, statistics and reports."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.eval.between": ("Between",),
        "benchnav.eval.compare": ("compare_runs",),
        "benchnav.eval.experiment.condition": ("Condition",),
        "benchnav.eval.evaluation": ("evaluate",),
        "benchnav.eval.experiment.suite": ("Suite",),
        "benchnav.eval.folder.steps": ("read_steps",),
        "benchnav.eval.report.write": ("read_report", "write_report"),
        "benchnav.eval.results": ("Comparison", "Results", "open_results as open_run"),
        "benchnav.eval.run.runner": ("run_suite",),
    },
)
