"""The files of the package whose functions a pair executes on its way through `submit`.

A run of two units of SIFT on the pair of docs/example, without scenes and page. Every process counts.
"""

import argparse
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
RECIPE = """
units = [
    { stage = 1, matcher = "sift", long_side = 640 },
    { stage = 2, matcher = "sift", long_side = 640 },
]
[focal]
"""
# Python imports this module at the start of each process. A worker may be killed, so names are written at once.
SITE = """
import os, sys, threading
known = set()
def note(frame, event, _):
    code = frame.f_code
    if event != "call" or code in known:
        return
    known.add(code)
    # Not the bodies of modules and classes, which an import executes
    is_function = code.co_flags & 1 and code.co_name != "<module>"
    if is_function and code.co_filename.startswith(os.environ["WAY_ROOT"]):
        with open(os.environ["WAY_OUT"], "a") as file:
            print(code.co_filename, code.co_qualname, sep="\\t", file=file)
threading.setprofile(note)
sys.setprofile(note)
"""


def functions_by_file(package: Path) -> dict[str, set[str]]:
    """Return the names of the executed functions by file, relative to the package."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        images = folder / "test_images" / "batch"
        images.mkdir(parents=True)
        for image in ("a", "b"):
            shutil.copyfile(ROOT / "docs" / "example" / f"{image}.jpg", images / f"{image}.jpg")
        row = "batch;a-b,batch,a,b\n"
        (folder / "test.csv").write_text(f"sample_id,batch_id,image_1_id,image_2_id\n{row}")
        (folder / "two.toml").write_text(RECIPE)
        (folder / "sitecustomize.py").write_text(SITE)
        trace = folder / "trace.tsv"
        environment = {
            **os.environ,
            "PYTHONPATH": f"{package.parent}{os.pathsep}{folder}",
            "WAY_ROOT": str(package),
            "WAY_OUT": str(trace),
        }
        options = ["--test-dir", name, "--recipe", f"{name}/two.toml", "--out", f"{name}/s.csv"]
        command = [sys.executable, "-m", "mkpc_kaggle", "submit", *options]
        switches = ["--no-scenes", "--no-report"]
        subprocess.run([*command, *switches], env=environment, cwd=folder, check=True)
        functions = defaultdict(set)
        for line in trace.read_text().splitlines():
            file, function = line.split("\t")
            functions[str(Path(file).relative_to(package))].add(function)
    return functions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--code", type=Path, default=ROOT, help="another checkout")
    arguments = parser.parse_args()
    package = (arguments.code / "mkpc_kaggle").resolve()
    functions = functions_by_file(package)
    for file in sorted(functions):
        lines = len((package / file).read_text(encoding="utf-8").splitlines())
        print(f"{file:<36} {len(functions[file]):3d} functions, {lines} lines")
    engine = sum(file.startswith("engine/") for file in functions)
    print(f"{len(functions)} files, {engine} of them in engine/")


if __name__ == "__main__":
    main()
