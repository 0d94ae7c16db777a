"""``trms serve`` as it is typed."""

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from http.cookiejar import CookieJar

import pytest

from tests.program import in_process, loaded_by
from trms_cli.library.server.application import listening_socket


def started(folder, *words: str) -> subprocess.Popen:
    """The program beside, in a folder."""
    command = [sys.executable, "-m", "trms_cli", "serve", *words]
    return subprocess.Popen(
        command,
        cwd=folder,
        env=os.environ | {"TRMS_RUNS": str(folder / ".index")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(("how", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_it_prints_its_address_answers_and_ends_cleanly(tmp_path, how, code) -> None:
    with started(tmp_path, "port=0") as program:
        lines = [program.stdout.readline() for _ in range(3)]
        (address,) = re.findall(r"http://127\.0\.0\.1:\d+/\?token=\S+", lines[1])
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
        page = opener.open(address, timeout=30).read().decode()
        assert "No run yet" in page and str(tmp_path.resolve()) in lines[0]
        program.send_signal(how)
        rest, trouble = program.communicate(timeout=20)
        assert program.returncode == code and "Traceback" not in trouble
        assert ("ended; nothing was written" in rest) == (code == 0)
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.1", int(re.findall(r":(\d+)/", address)[0])))


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["port=70000"], "70000 is no port"),
        (["--port", "x"], "'x' is no number"),
        (["nowhere"], "there is no folder 'nowhere'"),
        (["--all", "."], "--all goes without a folder"),
        (["--host", "0.0.0.0"], "'--host' is not understood"),
    ],
)
def test_what_cannot_be_served_is_told(tmp_path, words, problem) -> None:
    done = in_process(tmp_path, "serve", *words, code=2)
    assert problem in done.said and not done.stdout


def test_a_port_in_use_is_told_before_anything_is_read(tmp_path) -> None:
    with listening_socket(0) as own:
        port = own.getsockname()[1]
        done = in_process(tmp_path, "serve", f"port={port}", code=2)
    assert f"port {port} cannot be had" in done.said and "port=0" in done.said


def test_its_help_waits_for_no_server(tmp_path) -> None:
    loaded = loaded_by("import trms_cli.cli as c; c.main(['serve', '--help'])", tmp_path)
    assert not loaded & {"uvicorn", "starlette", "numpy"}
