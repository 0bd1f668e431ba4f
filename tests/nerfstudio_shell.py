"""Runs the `ns-` commands, each in a fork of one process that has paid for importing nerfstudio already.

A fork calls the entry point of the executable of that name with the command line, and ends as the interpreter ends:
its output, exit code and clean-up are those of the real command.
"""

import importlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numba

MODULES = {
    "ns-train": "nerfstudio.scripts.train",
    "ns-eval": "nerfstudio.scripts.eval",
    "ns-render": "nerfstudio.scripts.render",
    "ns-export": "nerfstudio.scripts.exporter",
    "ns-viewer": "nerfstudio.scripts.viewer.run_viewer",
}


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


class Shell:
    def __enter__(self):
        self._folder = tempfile.TemporaryDirectory()
        environment = {**os.environ, "COLUMNS": "300", "PYTORCH_NVML_BASED_CUDA_CHECK": "1"}
        self._server = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        return self

    def __exit__(self, *_):
        self._server.stdin.close()
        self._server.wait(60)
        self._server.stdout.close()
        self._folder.cleanup()

    def run(self, name, *arguments, environment=None, cwd=None):
        return self.wait(self.start(name, *arguments, environment=environment, cwd=cwd))

    def start(self, name, *arguments, environment=None, cwd=None):
        words, output = [name, *map(str, arguments)], str(Path(self._folder.name))
        return self._ask(start=words, environment=environment or {}, output=output, cwd=str(cwd or Path.cwd()))

    def wait(self, pid):
        code = self._ask(wait=pid)
        texts = [(Path(self._folder.name) / f"{pid}.{kind}").read_text() for kind in ("out", "err")]
        return Done(code, *texts)

    def _ask(self, **request):
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        return json.loads(self._server.stdout.readline())


def serve():
    """The request to start a command, returned in a fork made for it; the parent stays inside."""
    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            answer = os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])
        elif (answer := os.fork()) == 0:
            return request
        print(answer, file=answers, flush=True)
    os._exit(0)


def redirect(request):
    output = Path(request["output"]) / str(os.getpid())
    for number, kind in ((1, "out"), (2, "err")):
        os.dup2(os.open(f"{output}.{kind}", os.O_WRONLY | os.O_CREAT), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    entries = {name: importlib.import_module(module).entrypoint for name, module in MODULES.items()}
    numba.njit(lambda x: x + 1)(1)  # the first compiled function makes numba import the rest of itself
    command = serve()
    redirect(command)
    os.environ.update(command["environment"])
    os.chdir(command["cwd"])
    sys.argv = command["start"]
    entries[sys.argv[0]]()
