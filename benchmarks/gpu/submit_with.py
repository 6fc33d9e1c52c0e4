"""The command ``submit`` with faulty workers: one process of :mod:`benchmarks.gpu.runs`.

python -m benchmarks.gpu.submit_with FAULT HOME LIMIT_BYTES LAYERS submit --test-dir DIR ...

LAYERS are those of LightGlue with seeded weights; 0 stands for the trained weights of ``--weights``.
"""

import sys
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.gpu.faults import Fault, FaultyAssembly
from benchmarks.gpu.seeded import SeededWeights
from mkpc_kaggle.cli import main, options
from mkpc_kaggle.matchers.devices import resolve_placement
from mkpc_kaggle.recipe import load_recipe
from mkpc_kaggle.setup.assembly import Assembly, assemble


def run(words: list[str]) -> int:
    fault, home, limit, layers, *command = words
    more: dict[str, Any] = {"fault": Fault(fault), "home": Path(home), "limit": int(limit)}
    make = partial(assemble_seeded, layers=int(layers)) if int(layers) else assemble

    def assemble_faulty(*args: Any, **named: Any) -> FaultyAssembly:
        made = make(*args, **named)
        values: dict[str, Any] = {
            field.name: getattr(made, field.name) for field in fields(Assembly)
        }
        return FaultyAssembly(**values, **more)

    with patch.object(options, "assemble", assemble_faulty):
        return main(command)


def assemble_seeded(
    recipe: str, *, layers: int, device: str, precision: str, scenes: bool | None, **_: Any
) -> Assembly:
    """Return the assembly of a recipe with seeded weights, without looking for files."""
    chosen = load_recipe(recipe).with_scenes(scenes)
    weights = SeededWeights(layers=layers)
    return Assembly(chosen, weights, resolve_placement(device, precision), device=device)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
