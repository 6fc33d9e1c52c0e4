"""The command ``recipes``."""

import argparse

from mkpc_kaggle.cli import options
from mkpc_kaggle.pipeline.availability import unavailable
from mkpc_kaggle.recipe import load_recipe, recipe_names
from mkpc_kaggle.weights import WeightStore

HELP = """\
List the recipes: their units in order of importance, and missing weight files. A unit is printed as
stage:matcher@size, with its maximum number of matches. The size is the view's long side, or a height x width: the
view gets this area at its own aspect ratio, or exactly this height and width ("!").
A custom recipe is a TOML file in the format of the package's recipes: --recipe FILE.toml.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_weights(parser)


def run(arguments: argparse.Namespace) -> None:
    store = WeightStore(arguments.weights)
    for name in recipe_names():
        recipe = load_recipe(name)
        print(f"{name}: {recipe.description}")
        for unit in recipe.units:
            fallback = f"  (or {unit.fallback}, if its weights are missing)" if unit.fallback else ""
            print(f"    {unit.name}  at most {unit.max_matches}{fallback}")
        reasons = [f"    {matcher}: {reason}" for matcher, reason in unavailable(recipe, store).items()]
        print("\n".join(reasons or ["    all weights are available"]))
