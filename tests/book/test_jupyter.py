"""A notebook that is opened and saved untouched stands as it stood: converted by hand, or saved by a Jupyter server."""

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
from urllib.error import URLError
from urllib.request import Request, urlopen

import jupytext
import pytest
from jupytext.cli import jupytext as convert

from inflate_lib import paths
from inflate_lib.book.run import find_notebooks

NAMES = [path.name for path in find_notebooks()]
PATIENCE = 60  # seconds until the server answers
AGAIN = "jupytext --to ipynb {0}.md && jupytext --to md:myst {0}.ipynb"  # brings a source into its form


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of the notebooks, with the settings of their pairing."""
    folder = tmp_path_factory.mktemp("home") / "notebooks"
    folder.mkdir()
    for name in [*NAMES, "jupytext.toml"]:
        shutil.copy(paths.NOTEBOOKS / name, folder)
    return folder


class Server:
    """A Jupyter server on the loopback interface."""

    def __init__(self, folder):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        token = secrets.token_hex()
        self.address, self.headers = f"http://127.0.0.1:{port}/api", {"Authorization": f"token {token}"}
        places = {f"JUPYTER_{kind}_DIR": str(folder.parent / kind) for kind in ("CONFIG", "DATA", "RUNTIME")}
        options = [f"--ServerApp.port={port}", "--ServerApp.port_retries=0", f"--ServerApp.root_dir={folder}"]
        self.log = folder.parent / "server.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "jupyter_server", "--no-browser", "--allow-root", *options],
                env={**os.environ, **places, "JUPYTER_TOKEN": token},
                stdout=log,
                stderr=log,
            )

    def wait(self):
        until = time.monotonic() + PATIENCE
        while True:
            try:
                return self.ask("GET", "status")
            except URLError:
                if self.process.poll() is not None or time.monotonic() > until:
                    pytest.fail(f"the Jupyter server does not answer:\n{self.log.read_text()[-2000:]}")
                time.sleep(0.1)

    def ask(self, method, path, content=None):
        data = None if content is None else json.dumps(content).encode()
        with urlopen(Request(f"{self.address}/{path}", data, self.headers, method=method), timeout=PATIENCE) as answer:
            return json.load(answer)

    def open_and_save(self, name, kernel=None):
        """What JupyterLab does; where a kernel was started, it notes which."""
        notebook = self.ask("GET", f"contents/{name}?type=notebook")["content"]
        notebook["metadata"] |= kernel or {}
        self.ask("PUT", f"contents/{name}", {"type": "notebook", "format": "json", "content": notebook})


@pytest.fixture(scope="module")
def server(folder):
    pytest.importorskip("jupyter_server")
    server = Server(folder)
    try:
        server.wait()
        yield server
    finally:
        server.process.terminate()
        server.process.wait(PATIENCE)


@pytest.mark.parametrize("name", NAMES)
def test_a_source_survives_the_conversion_to_ipynb_and_back(folder, tmp_path, name):
    for file in (name, "jupytext.toml"):
        shutil.copy(folder / file, tmp_path)
    source, notebook = tmp_path / name, (tmp_path / name).with_suffix(".ipynb")
    convert(["--quiet", "--to", "ipynb", str(source)])
    source.unlink()
    convert(["--quiet", "--to", "md:myst", str(notebook)])
    stem = source.stem
    assert source.read_bytes() == (paths.NOTEBOOKS / name).read_bytes(), f"write it anew: {AGAIN.format(stem)}"


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_source_saved_by_a_jupyter_server_is_unchanged(server, folder, name):
    """First without its pair, which the first save makes, then with it and a kernel, with the answers that it gave."""
    before = (paths.NOTEBOOKS / name).read_bytes()
    server.open_and_save(name)
    pair = (folder / name).with_suffix(".ipynb")
    assert (folder / name).read_bytes() == before and pair.is_file()
    spec = {"name": "python3", "display_name": "Python 3 (ipykernel)", "language": "python"}
    language = {"name": "python", "version": "3.12.1", "mimetype": "text/x-python", "pygments_lexer": "ipython3"}
    server.open_and_save(name, {"kernelspec": spec, "language_info": language})
    assert (folder / name).read_bytes() == before
    assert jupytext.read(pair).metadata["kernelspec"] == spec


def test_a_changed_number_is_a_changed_line(server, folder):
    name = "06_descriptors.md"
    notebook = server.ask("GET", f"contents/{name}?type=notebook")["content"]
    cell = next(cell for cell in notebook["cells"] if "parameters" in cell["metadata"].get("tags", []))
    cell["source"] = cell["source"].replace("n_checked = 30", "n_checked = 31")
    server.ask("PUT", f"contents/{name}", {"type": "notebook", "format": "json", "content": notebook})
    before, after = ((place / name).read_text(encoding="utf-8") for place in (paths.NOTEBOOKS, folder))
    assert after == before.replace("n_checked = 30", "n_checked = 31", 1) != before
