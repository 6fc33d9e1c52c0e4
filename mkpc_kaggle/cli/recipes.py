"""The command ``recipes``."""

import argparse

from mkpc_kaggle.cli import options
from mkpc_kaggle.pipeline.availability import unavailable
from mkpc_kaggle.recipe import load_recipe, recipe_names
from mkpc_kaggle.weights import WeightStore

HELP = """\
List the recipes: their units in order of importance, and which weight files are missing. A unit reads
stage:matcher@size, where the size is the view's long side, or the height x width whose area the view gets at
its own aspect ("!": that height and width themselves), and the most matches that are kept.
A recipe of your own is a TOML file of the form of those in the package: --recipe FILE.toml.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_weights(parser)


def run(arguments: argparse.Namespace) -> int:
    store = WeightStore(arguments.weights)
    for name in recipe_names():
        recipe = load_recipe(name)
        print(f"{name}: {recipe.description}")
        for unit in recipe.units:
            fallback = f"  (or {unit.fallback}, where its weights are missing)" if unit.fallback else ""
            print(f"    {unit.name}  at most {unit.max_matches}{fallback}")
        reasons = [f"    {matcher}: {reason}" for matcher, reason in unavailable(recipe, store).items()]
        print("\n".join(reasons or ["    all weights are there"]))
    return 0
