"""Installs the package, editable, with some of its extras into the environment of the
Python that runs this file.

uv installs in about a minute what takes pip several. If uv fails for any reason, pip
installs. uv does not read pip's settings, so those that name where packages come from
are passed on; with others that change what is installed, pip installs as well. Needs
only Python and pip, since it runs before anything is installed.

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
# pip takes the best version of all indexes. Bytecode is compiled as pip does, or else
# each process would do so in an environment that nobody else may write to.
AS_PIP = ("--index-strategy", "unsafe-best-match", "--compile-bytecode")
# A setting of pip, the variable that uv reads for it, and what uv separates its values
# by.
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
    """Reads the settings that `pip install` would use.

    Args:
        listing: what `pip config list` prints, such as `global.timeout='60'`.

    Returns:
        Values by name: those of variables before those of `[install]`, and these before
            those of `[global]`.
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
    """Returns variables that have uv look for packages where pip does.

    Args:
        settings: settings of pip, by name.

    Returns:
        Values by the name of the variable.

    Raises:
        ValueError: If a setting is not known to uv.
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
    """Installs uv, then the requirement.

    Args:
        requirement: arguments of `pip install`.

    Raises:
        OSError, ValueError, subprocess.CalledProcessError: If uv cannot be used, or
        fails.
    """

    def run(*command: str, **variables: str) -> str:
        environment = variables | os.environ  # what the user says to uv goes first
        return subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True
        ).stdout

    variables = uv_environment(read_settings(run(*PIP, "config", "list")))
    run(*PIP, "install", "--only-binary", ":all:", "--constraint", str(PINS), "uv")
    run(*UV, *AS_PIP, *requirement, **variables)


def why(error: Exception) -> str:
    """Returns the first line of what an installer printed about an error, or of the
    error itself.
    """
    printed = (getattr(error, "stderr", "") or "").strip()
    return (printed or str(error)).splitlines()[0]


def main() -> int:
    """Installs with uv, or else with pip, and returns the exit status."""
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
            "benchnav: installing with pip, several minutes, since uv failed: "
            f"{why(error)}",
            file=sys.stderr,
        )
        return subprocess.run([*PIP, "install", *requirement]).returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
