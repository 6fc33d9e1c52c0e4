"""Prints the lowest versions that ``pyproject.toml`` declares, ``name==version`` a line, for ``make
oldest``.

Arguments name extras to add. ``torch`` is left out, since few indexes have CPU builds of its old
versions, and so is what has no lower bound, such as type stubs.
"""

import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
LEFT_OUT = ("torch", "ruff", "mypy")  # the last two run in `make lint` only


def lowest_versions(extras: Sequence[str]) -> Iterator[str]:
    """Each dependency at its floor, once; raises ``KeyError`` for an extra that is not declared."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    more = [line for name in extras for line in project["optional-dependencies"][name]]
    for line in dict.fromkeys([*project["dependencies"], *more]):
        floor = re.match(r"([A-Za-z0-9_.-]+)>=([0-9.]+)", line)
        if floor and floor[1] not in LEFT_OUT:
            yield f"{floor[1]}=={floor[2]}"


if __name__ == "__main__":
    print("\n".join(lowest_versions(sys.argv[1:])))
