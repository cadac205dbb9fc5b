"""What the viewer says of a recording in words."""

from collections.abc import Sequence

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.contenders import NAMING
from benchnav.eval.report.playback.robot import Driver
from benchnav.eval.report.recorded.recording import Recording


def describe(drivers: Sequence[Driver]) -> str:
    """Says in Markdown what is shown, how each episode ended, and which ground was free."""
    about = drivers[0].recording.about
    lines = [f"# {about['data']}, {about['scenario']} {about['map']}", ""]
    lines += [f"Seed {about['seed']}, realisation {about['realisation']}", ""]
    if len(drivers) == 1:
        recording = drivers[0].recording
        lines += [f"**{recording.outcome}** after {recording.end_s:.1f} s of {recording.time_budget_s:g} s"]
        lines += [
            "",
            f"observed λ on average: {_mean_met(recording)}",
            "",
            f"Free: {free_rule(recording)}",
            "",
        ]
        used = [(name, about[name]) for name in NAMING if about.get(name, NOT_USED) != NOT_USED]
        return "\n".join([*lines, "| | |", "|---|---|", *(f"| {n} | {v} |" for n, v in used)])
    lines += ["| condition | outcome | time [s] | observed λ | free |", "|---|---|---|---|---|"]
    for driver in drivers:
        recording = driver.recording
        cells = (driver.name, f"**{recording.outcome}**", f"{recording.end_s:.1f}", _mean_met(recording))
        lines.append(f"| {' | '.join(cells)} | {free_rule(recording)} |")
    return "\n".join(lines)


def free_rule(recording: Recording) -> str:
    """Which ground was free, in words."""
    by = "mean λ" if recording.free_by == "mean" else "λ̂"
    return f"{by} above {recording.free_above:g}"


def _mean_met(recording: Recording) -> str:
    return f"{recording.traversability.mean():.2f}" if len(recording.traversability) else NOT_USED
