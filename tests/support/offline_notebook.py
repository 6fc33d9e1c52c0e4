"""Notebooks executed from a clean kernel in a network namespace without interfaces.

As a program it executes a notebook in place and keeps its pictures: ``offline_notebook.py
NOTEBOOK``.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
import pytest

EXECUTE = """
import sys
import nbformat
from nbclient import NotebookClient
from traitlets.config import Config

notebook = nbformat.read(sys.argv[1], as_version=4)
try:
    # Sockets on disk: without a network there is no 127.0.0.1 either.
    NotebookClient(notebook, timeout=None, config=Config(KernelManager={"transport": "ipc"})).execute()
finally:
    nbformat.write(notebook, sys.argv[2])
"""
OFFLINE = ("unshare", "--map-root-user", "--net")
HAS_NAMESPACES = (
    shutil.which("unshare")
    and subprocess.run([*OFFLINE, "true"], check=False).returncode == 0
)
needs_namespaces = pytest.mark.skipif(
    not HAS_NAMESPACES, reason="unshare --net is not permitted here"
)


def execute(
    notebook: Path,
    executed: Path,
    python: str | Path,
    working: Path,
    variables: Mapping[str, str],
) -> nbformat.NotebookNode:
    """Run ``notebook`` in ``working`` under that interpreter; the executed notebook, also in
    ``executed``.
    """
    command = [*OFFLINE, str(python), "-c", EXECUTE, str(notebook), str(executed)]
    # Not under pytest's own directory: the path of a socket may have no more than 107 characters.
    with TemporaryDirectory(prefix="mkpc-") as runtime:
        env = {**variables, "JUPYTER_RUNTIME_DIR": runtime}
        settings = {"env": env, "cwd": working}
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, **settings
        )
    assert done.returncode == 0, done.stderr
    return nbformat.read(executed, as_version=4)


def printed(notebook: nbformat.NotebookNode) -> str:
    return "".join(
        output["text"] for output in outputs(notebook) if output["output_type"] == "stream"
    )


def pictures(notebook: nbformat.NotebookNode) -> int:
    return sum(
        bool({"image/png", "image/jpeg"} & set(output.get("data", {})))
        for output in outputs(notebook)
    )


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def with_pictures_alone(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return the committed form of the tour: its pictures, and no other trace of a run."""
    kept = deepcopy(notebook)
    kept.metadata = {name: kept.metadata[name] for name in ("kernelspec", "language_info")}
    kept.metadata["language_info"] = {"name": "python"}
    for cell in kept.cells:
        cell.metadata = {}  # times of the execution
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = [
                nbformat.v4.new_output(
                    "display_data", {"image/jpeg": output["data"]["image/jpeg"]}
                )
                for output in cell.outputs
                if "image/jpeg" in output.get("data", {})
            ]
    return kept


def main(path: Path) -> None:
    with TemporaryDirectory() as directory:
        executed = execute(
            path, Path(directory) / "executed.ipynb", sys.executable, path.parent, os.environ
        )
    path.write_text(nbformat.writes(with_pictures_alone(executed)) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
