"""The report as one HTML page, which needs no other file and no network."""

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

import benchnav
from benchnav.core.tables import Table
from benchnav.eval.folder.provenance import command_lines
from benchnav.eval.report.findings import Finding


def write_page(
    name: str,
    header: Sequence[str],
    warnings: Sequence[str],
    findings: Sequence[Finding],
    table: Table,
    figures: Mapping[Path, str],
    about: Mapping[str, Any],
) -> str:
    """Writes the page; all text is escaped.

    Args:
        name: of the run.
        header: lines on where the rows come from.
        warnings: lines on what went wrong.
        findings: what the run says.
        table: a row a condition.
        figures: by the path of its PNG what each shows.
        about: all of `run.json`.

    Returns:
        HTML.
    """
    environment = Environment(
        loader=PackageLoader("benchnav.eval.report", "templates"), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template("report.html").render(
        name=name,
        header=header,
        warnings=warnings,
        findings=findings,
        table=table,
        figures=[(path.stem, caption, _inline(path)) for path, caption in figures.items()],
        provenance=provenance_lines(about),
        commands=command_lines(about),
        version=benchnav.__version__,
    )


def provenance_lines(about: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Says where a run came from, (what, value).

    Args:
        about: all of `run.json`.
    """
    machine, codes = about["machine"], about["codes"].values()
    lines = [
        ("commit of benchnav", about["history"][-1]["commit"]),
        ("version of benchnav", about["history"][-1]["benchnav"]),
    ]
    for environment in {json.dumps(code["environment"]): code["environment"] for code in codes}.values():
        lines += [(name, str(value)) for name, value in environment.items()]
    lines.append(("machine", f"{machine['processor']}, {machine['cores']} cores"))
    for data, known in about["datasets"].items():
        maps = ", ".join(f"{split} {len(digests)}" for split, digests in known["maps"].items())
        lines.append((f"dataset {data}", f"{known['id']}; maps: {maps}"))
    lines += dict.fromkeys(part for code in codes for part in code["parts"].items())
    seeds = dict.fromkeys(seed for condition in about["conditions"].values() for seed in condition["seeds"])
    lines.append(("seeds", ", ".join(map(str, seeds))))
    return [(name, value) for name, value in lines if value]


def _inline(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
