"""Install the package, editable, with extras into the environment of this Python.

uv takes about a minute, pip several. If uv fails for any reason, pip is used. uv does
not read pip's settings, so the sources of packages among them are passed on. If other
settings change what is installed, pip is used too. This script runs before anything is
installed, so it needs only Python and pip.

    .venv/bin/python tools/install.py [--constraint FILE] EXTRA[,EXTRA …]
"""

import argparse
import ast
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PINS = ROOT / "constraints.txt"
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
UV = (
    sys.executable,
    "-m",
    "uv",
    "--quiet",
    "pip",
    "install",
    "--python",
    sys.executable,
)
# Like pip, choose the best version over all indexes and compile bytecode. Without
# bytecode, every process would compile the modules again if it may not write to the
# environment.
AS_PIP = ("--index-strategy", "unsafe-best-match", "--compile-bytecode")
# Setting of pip, environment variable of uv, separator of the variable's values.
SOURCES = (
    ("index-url", "UV_DEFAULT_INDEX", " "),
    ("extra-index-url", "UV_INDEX", " "),
    ("find-links", "UV_FIND_LINKS", ","),
    ("trusted-host", "UV_INSECURE_HOST", " "),
    ("cert", "SSL_CERT_FILE", " "),
)
ONLY_PIP = (
    "no-index",
    "proxy",
    "client-cert",
    "constraint",
    "no-binary",
    "only-binary",
    "pre",
    "require-hashes",
)


def read_settings(listing: str) -> dict[str, str]:
    """Read the settings that `pip install` would use.

    Args:
        listing: output of `pip config list`, such as `global.timeout='60'`.

    Returns:
        Values by name. Environment variables override `[install]`, which overrides
            `[global]`.
    """
    sections: dict[str, dict[str, str]] = {"global": {}, "install": {}, ":env:": {}}
    for line in listing.splitlines():
        key, _, value = line.partition("=")
        section, _, name = key.partition(".")
        if section in sections:
            sections[section][name] = ast.literal_eval(value)
    return {
        name: value for section in sections.values() for name, value in section.items()
    }


def uv_environment(settings: dict[str, str]) -> dict[str, str]:
    """Return environment variables that make uv use pip's sources of packages.

    Args:
        settings: settings of pip, by name.

    Returns:
        Values by the name of the variable.

    Raises:
        ValueError: If a setting has no counterpart in uv.
    """
    unknown = [name for name in ONLY_PIP if name in settings]
    if unknown:
        raise ValueError(f"pip's setting {unknown[0]!r} is not passed on")
    return {
        variable: separator.join(settings[name].split())
        for name, variable, separator in SOURCES
        if name in settings
    }


def install_with_uv(requirement: list[str]) -> None:
    """Install uv, and the requirement with uv.

    Args:
        requirement: arguments of `pip install`.

    Raises:
        OSError, ValueError, subprocess.CalledProcessError: If uv cannot be used or
            fails.
    """

    def run(*command: str, **variables: str) -> str:
        environment = variables | os.environ  # the user's settings of uv come first
        return subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True
        ).stdout

    variables = uv_environment(read_settings(run(*PIP, "config", "list")))
    run(*PIP, "install", "--only-binary", ":all:", "--constraint", str(PINS), "uv")
    run(*UV, *AS_PIP, *requirement, **variables)


def why(error: Exception) -> str:
    """Return the first line that an installer printed, or else that of the error."""
    printed = (getattr(error, "stderr", "") or "").strip()
    return (printed or str(error)).splitlines()[0]


def main() -> int:
    """Install with uv, or with pip if uv fails; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("extras", help="extras to install, such as docs or dask,geo")
    parser.add_argument(
        "--constraint", default=str(PINS), help="file of the versions to install"
    )
    arguments = parser.parse_args()
    requirement = [
        "--constraint",
        arguments.constraint,
        "--editable",
        f"{ROOT}[{arguments.extras}]",
    ]
    try:
        install_with_uv(requirement)
    except (OSError, ValueError, subprocess.CalledProcessError) as error:
        print(
            "benchnav: installing with pip, which takes several minutes, because uv "
            f"failed: {why(error)}",
            file=sys.stderr,
        )
        return subprocess.run([*PIP, "install", *requirement]).returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
