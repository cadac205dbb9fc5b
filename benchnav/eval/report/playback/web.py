"""The Rerun viewer in a browser, served only to this machine."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from benchnav.core.errors import BenchnavError

HOST = "127.0.0.1"

# Default ports of the viewer, which users may forward to another machine.
_PAGE_PORT = 9090
_DATA_PORT = 9876
_START_S = 60.0


def serve(path: Path) -> None:
    """Serve the viewer with a recording until Ctrl-C, and print its address.

    Args:
        path: an `.rrd` file.

    Raises:
        BenchnavError: If the viewer did not start.
    """
    page = _free_port(_PAGE_PORT)
    data = _free_port(_DATA_PORT)
    command = [
        sys.executable,
        "-m",
        "rerun_cli",
        str(path),
        "--serve-web",
        "--bind",
        HOST,
    ]
    command += ["--web-viewer-port", str(page), "--port", str(data)]
    # The viewer has a child process. Both end as a process group.
    viewer = subprocess.Popen(
        command, env={**os.environ, "RUST_LOG": "error"}, start_new_session=True
    )
    # A background process of a script ignores Ctrl-C unless it sets handlers.
    before = {
        number: signal.signal(number, signal.default_int_handler)
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        _wait_for(page, viewer)
        _wait_for(data, viewer)
        source = quote(f"rerun+http://{HOST}:{data}/proxy", safe="")
        address = f"http://{HOST}:{page}?url={source}"
        print(f"viewer:  {address}\nCtrl-C ends it", flush=True)
        viewer.wait()
    except KeyboardInterrupt:
        pass
    finally:
        with suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()
        for number, handler in before.items():
            signal.signal(number, handler)


def _free_port(preferred: int) -> int:
    """Return the preferred port if it is free, otherwise any free port."""
    for port in (preferred, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise BenchnavError(
        "Expected a free port for the viewer, got none. Close other servers."
    )


def _wait_for(port: int, viewer: subprocess.Popen[bytes]) -> None:
    began = time.monotonic()
    while time.monotonic() - began < _START_S and viewer.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.05)
    raise BenchnavError(
        f"Expected the viewer to start within {_START_S:g} s, but it did not. Open the "
        "recording with `rerun` to see the reason."
    )
