"""`tools/install.py` has uv look where pip looks, and pip install where uv does not."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[1] / "tools" / "install.py"


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("install", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", ["install.py", "docs"])
    for variable in (
        "UV_DEFAULT_INDEX",
        "UV_INDEX",
        "UV_FIND_LINKS",
        "UV_INSECURE_HOST",
        "SSL_CERT_FILE",
    ):
        monkeypatch.delenv(variable, raising=False)
    return module


class Installers:
    """Records commands in place of running them; those with `failing` in them fail, and
    pip's last has status 3.
    """

    def __init__(self, listing: str = "", failing: str = "\0") -> None:
        self.listing, self.failing = listing, failing
        self.commands: list[list[str]] = []
        self.variables: dict[str, str] = {}

    def run(
        self, command: list[str], env: Any = None, **_: Any
    ) -> subprocess.CompletedProcess[str]:
        self.commands.append(list(command[2:]))
        if self.failing in command:
            raise subprocess.CalledProcessError(2, command, stderr="error: no\nmore")
        if command[2] == "uv":
            self.variables = env
        status = 3 if command[2] == "pip" and "--editable" in command else 0
        return subprocess.CompletedProcess(command, status, self.listing, "")


def test_settings_of_pip_go_to_uv_and_variables_of_uv_go_first(
    install: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    listing = """\
:env:.find-links='/wheels /more'
global.extra-index-url='\\nhttps://one.example/simple\\nhttps://two.example/simple'
global.find-links='/other'
global.index-url='https://global.example/simple'
global.timeout='60'
install.index-url='https://install.example/simple'
install.trusted-host='one.example'
"""
    installers = Installers(listing)
    monkeypatch.setattr(subprocess, "run", installers.run)
    monkeypatch.setenv("UV_INSECURE_HOST", "mine.example")
    assert install.main() == 0
    assert capsys.readouterr().err == ""
    expected = {
        "UV_DEFAULT_INDEX": "https://install.example/simple",
        "UV_INDEX": "https://one.example/simple https://two.example/simple",
        "UV_FIND_LINKS": "/wheels,/more",
        "UV_INSECURE_HOST": "mine.example",
    }
    assert {name: installers.variables.get(name) for name in expected} == expected
    assert installers.commands[-1][0] == "uv"
    assert installers.commands[-1][-1] == f"{SCRIPT.parents[1]}[docs]"


@pytest.mark.parametrize(
    ("installers", "why"),
    [
        (Installers(failing="uv"), "error: no"),
        (Installers(failing="config"), "error: no"),
        (
            Installers("global.no-index='true'"),
            "pip's setting 'no-index' is not passed on",
        ),
    ],
    ids=["uv", "pip config", "setting"],
)
def test_pip_installs_where_uv_does_not(
    install: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    installers: Installers,
    why: str,
) -> None:
    monkeypatch.setattr(subprocess, "run", installers.run)
    assert install.main() == 3
    said = capsys.readouterr().err
    assert said == (
        "benchnav: installing with pip, which takes several minutes, because uv "
        f"failed: {why}\n"
    )
    assert installers.commands[-1][0] == "pip"
    constraint = ["--constraint", str(SCRIPT.parents[1] / "constraints.txt")]
    assert installers.commands[-1][-5:] == [
        "install",
        *constraint,
        "--editable",
        f"{SCRIPT.parents[1]}[docs]",
    ]
