"""Every benchmark can be imported, and its command prints its help."""

import pkgutil
import subprocess
import sys
from pathlib import Path

import benchmarks

ROOT = Path(__file__).parents[1]
# One process: the imports of torch and pycolmap take seconds.
PROGRAM = """
import importlib, sys
for name in sys.argv[1:]:
    module = importlib.import_module(name)
    if not hasattr(module, "main"):
        continue
    sys.argv = [name, "--help"]
    try:
        module.main()
    except SystemExit as end:
        assert not end.code, f"{name} ended with {end.code}"
        print(f"help of {name}")
"""


def test_every_benchmark_can_be_imported_and_prints_its_help() -> None:
    names = [each.name for each in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *names],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    helped = {line.removeprefix("help of ") for line in done.stdout.splitlines()}
    commands = [name for name in names if "argparse" in source(name)]
    assert len(commands) > 10
    assert [name for name in commands if name not in helped] == []


def source(name: str) -> str:
    path = ROOT / name.replace(".", "/")
    return "" if path.is_dir() else path.with_suffix(".py").read_text()
