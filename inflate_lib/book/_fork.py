"""A process that has imported what every notebook imports, and forks a kernel for each, which so starts at once.

PyTorch, scikit-learn, Seaborn and the rest take seconds to import, which is longer than most chapters compute.
``python -m inflate_lib.book._fork`` says that it is ready, reads orders from its standard input, a line of JSON each,
and answers with the process id of a kernel that it has forked. It ends with that input, and with it end its kernels.
"""

import atexit
import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from threading import Lock
from typing import Any

from jupyter_client.provisioning import LocalProvisioner

#: Packages alone: modules of this library are cheap, and may look at their environment.
_IMPORTED = ("torch", "numba", "pandas", "xarray", "matplotlib.pyplot", "seaborn", "sklearn.cluster")
_IMPORTED += ("skimage.morphology", "scipy.optimize", "ipykernel.kernelapp")
_READY = "ready\n"
#: A process that has threads cannot be forked safely; on macOS, system libraries start them on import.
POSSIBLE = sys.platform == "linux"


class ForkServer:
    """The process, seen from the one that runs the notebooks."""

    def __init__(self, environment: Mapping[str, str], folder: str):
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=dict(environment), cwd=folder, start_new_session=True, text=True,
        )  # fmt: skip
        assert self._process.stdin
        assert self._process.stdout
        self._orders, self._answers = self._process.stdin, self._process.stdout
        self._lock, self._ready = Lock(), False

    def ready(self, patience: float = 0.0) -> bool:
        """Whether it can fork, after `patience` seconds at the latest; until then, and once it has ended, it cannot."""
        with self._lock:
            if not self._ready and select.select([self._answers], [], [], patience)[0]:
                self._ready = self._answers.readline() == _READY
            return self._ready and self._process.poll() is None

    def fork(self, command: list[str], env: Mapping[str, str], cwd: str, words: str) -> int:
        """Make a kernel as ``python -m …`` would, and say its process id; it leads a process group of its own."""
        order = {"module": command[2], "arguments": command[3:], "env": dict(env), "cwd": cwd, "words": words}
        with self._lock:
            try:
                self._orders.write(json.dumps(order) + "\n")
                self._orders.flush()
                return int(self._answers.readline())
            except (OSError, ValueError):
                raise RuntimeError("the process that notebooks are forked from has ended: out of memory?") from None

    def stop(self) -> None:
        """End it; kernels that still run are for the caller to end."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._orders, self._answers):
            with suppress(OSError):  # an order that it did not read
                pipe.close()


class _Forked:
    """A kernel's process, as much of a ``Popen`` as Jupyter's provisioner asks for. It is not a child of this one."""

    stdin = stdout = stderr = None

    def __init__(self, pid: int):
        self.pid = pid

    def poll(self) -> int | None:
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return 1
        return None

    def wait(self) -> int:
        return 1  # it is asked for only once `poll` has said so

    def send_signal(self, number: int) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)


class ForkedKernel(LocalProvisioner):
    """Jupyter's local kernel, forked instead of started."""

    def __init__(self, server: ForkServer, words: str, **options: Any):
        super().__init__(**options)
        self._server, self._words = server, words

    async def launch_kernel(self, cmd, **options):
        self.pid = self.pgid = self._server.fork(cmd, options["env"], options["cwd"], self._words)
        self.process = _Forked(self.pid)
        return self.connection_info


def _become(order: dict[str, Any]) -> None:
    """Turn this process, just forked, into what was ordered."""
    os.setsid()
    os.write(1, f"{os.getpid()}\n".encode())
    for number, path, how in ((0, os.devnull, os.O_RDONLY), (1, order["words"], os.O_WRONLY | os.O_CREAT)):
        os.dup2(os.open(path, how), number)
    os.dup2(1, 2)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.environ.update(order["env"])  # besides what the packages have set for themselves
    os.chdir(order["cwd"])
    sys.argv = [order["module"], *order["arguments"]]
    runpy.run_module(order["module"], run_name="__main__")


def _serve() -> None:
    os.environ["JPY_PARENT_PID"] = str(os.getpid())  # a kernel ends with this process; ipykernel reads it on import
    for name in _IMPORTED:
        importlib.import_module(name)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the kernels: they leave no zombies
    print(_READY, end="", flush=True)
    for line in sys.stdin:
        if os.fork() == 0:
            _become(json.loads(line))
            atexit._run_exitfuncs()
            os._exit(0)  # at once: to take all that was imported apart lasts a second or two


if __name__ == "__main__":
    _serve()
