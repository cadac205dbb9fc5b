"""The viewer in a browser: served to this machine alone, until it is interrupted."""

import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import psutil
import pytest

from benchnav.eval.report.playback.viewer_file import write_rerun
from benchnav.eval.report.playback.web import HOST, _free_port
from tests.eval.report import made


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_the_viewer_is_served_here_alone_until_it_is_told_to_end(
    tmp_path: Path, end: signal.Signals
) -> None:
    path = tmp_path / "one.rrd"
    write_rerun([made.recording(5)], path)
    code = (
        "import sys; from pathlib import Path; from benchnav.eval.report.playback.web import serve; "
        "serve(Path(sys.argv[1]))"
    )
    family: list[psutil.Process] = []
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found
        address = urlsplit(found[0])
        assert address.hostname == HOST
        with urlopen(f"http://{address.netloc}/", timeout=30) as page:
            assert b"rerun" in page.read().lower()
        (data,) = parse_qs(address.query)["url"]
        assert data.startswith(f"rerun+http://{HOST}:")
        (viewer,) = psutil.Process(process.pid).children()
        family = [viewer, *viewer.children(recursive=True)]
        connections = [
            connection for member in family for connection in member.net_connections()
        ]
        held = {
            connection.laddr
            for connection in connections
            if connection.status == psutil.CONN_LISTEN
        }
        assert {place.ip for place in held} == {HOST}
        assert {address.port, urlsplit(data.removeprefix("rerun+")).port} <= {
            place.port for place in held
        }
        process.send_signal(end)
        assert process.wait(60) == 0
        assert not psutil.wait_procs(family, timeout=30)[1]
    finally:
        process.kill()
        process.wait()
        for member in family:
            with suppress(psutil.NoSuchProcess):
                member.kill()


def test_a_port_that_is_taken_is_left_alone() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert _free_port(port) != port
