"""Commands in forks of a process that has imported the program and loaded its machine code.

So each starts some seconds sooner than a new Python. `python -m tests.support.prefork` reads a request in JSON from
each line of its input. It answers with the number of the forked process, and then with its exit code. Only one thread
runs before a fork.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
from functools import cache
from importlib import import_module
from pathlib import Path

from tests.support import ROOT
from usvlearn.cli.warm import warm

IMPORTED = (  # what train.py and evaluate.py import while they work
    "usvlearn.cli.train", "usvlearn.cli.evaluate", "usvlearn.sweeps.tuning.tune", "usvlearn.runs.tensorboard.logger",
    "usvlearn.report.from_runs", "usvlearn.report.stability", "usvlearn.simulate.fleet", "matplotlib.figure",
)  # fmt: skip


def run(command: list[str], folder: Path, environment: dict[str, str], timeout: float) -> subprocess.CompletedProcess:
    """As `subprocess.run` of a script of Python with captured text."""
    with tempfile.TemporaryDirectory() as files:
        out, err = Path(files, "out"), Path(files, "err")
        request = {"arguments": command[1:], "folder": str(folder), "environment": environment}
        server = _server()
        server.stdin.write(json.dumps({**request, "out": str(out), "err": str(err)}) + "\n")
        process = int(server.stdout.readline())
        if not select.select([server.stdout], [], [], timeout)[0]:
            os.kill(process, signal.SIGKILL)
            server.stdout.readline()
            raise subprocess.TimeoutExpired(command, timeout, out.read_bytes(), err.read_bytes())
        code = int(server.stdout.readline())
        return subprocess.CompletedProcess(command, code, out.read_text(), err.read_text())


@cache
def _server() -> subprocess.Popen:
    server = subprocess.Popen(
        [sys.executable, "-m", "tests.support.prefork"], cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
    )  # fmt: skip
    atexit.register(_end, server)
    return server


def _end(server: subprocess.Popen) -> None:
    with server:  # closes its input, at which it ends
        pass


def _serve() -> dict:
    """Fork for each request; returns the request, in the fork."""
    for name in IMPORTED:
        import_module(name)
    warm()
    gc.collect()
    gc.freeze()  # a collection in a fork touches, and so copies, none of this
    for line in sys.stdin:
        if process := os.fork():
            print(process, flush=True)
            print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
        else:
            return json.loads(line)
    sys.exit()


def main() -> None:
    request = _serve()
    for number, path, mode in ((0, os.devnull, os.O_RDONLY), (1, request["out"], os.O_WRONLY | os.O_CREAT),
                               (2, request["err"], os.O_WRONLY | os.O_CREAT)):  # fmt: skip
        os.dup2(opened := os.open(path, mode, 0o600), number)
        os.close(opened)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.argv = request["arguments"]
    sys.path[0] = str(Path(sys.argv[0]).parent)
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
