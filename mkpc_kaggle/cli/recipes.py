"""The command ``recipes``."""

import argparse

from mkpc_kaggle.cli import options
from mkpc_kaggle.recipe import Recipe, load_recipe, recipe_names
from mkpc_kaggle.setup.assembly import fetch_command, listed, missing_weights, recipe_of_name
from mkpc_kaggle.weights import WeightStore

HELP = """\
List the recipes, one per line. With a name or a file, list its units in order of importance, and the
matchers that cannot run here.

A unit is printed as stage:matcher@size, with its maximum number of matches. The size is the view's long
side, or a height x width: the view gets this area at its own aspect ratio, or exactly this height and
width ("!"). A custom recipe is a TOML file in the format of the package's recipes: --recipe FILE.toml.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    text = "list the units of this recipe, or of one matcher"
    parser.add_argument("name", nargs="?", metavar="NAME|FILE.toml", help=text)
    options.add_weights(parser)


def run(arguments: argparse.Namespace) -> None:
    store = WeightStore(arguments.weights)
    if arguments.name is not None:
        recipe = recipe_of_name(arguments.name)
        print("\n".join(unit_lines(recipe, store)))
        return
    rows = [("recipe", "runs here", "matchers")]
    for name in recipe_names():
        recipe = load_recipe(name)
        count = len(recipe.matcher_names)
        present = count - len(missing_weights(recipe, store))
        rows.append((name, f"{present} of {count}", recipe.description))
    options.print_table(rows)
    print("\n`mkpc recipes NAME` lists the units and the missing weights of a recipe.")


def unit_lines(recipe: Recipe, store: WeightStore) -> list[str]:
    """Return lines: the description, each unit, and the recipe's missing weights."""
    lines = [f"{recipe.name}: {recipe.description}"]
    for unit in recipe.units:
        lines.append(f"  {unit.name:<30}at most {unit.max_matches} matches")
    missing = missing_weights(recipe, store)
    if not missing:
        return [*lines, "all weights are available"]
    lines.append(f"no weights; `{fetch_command(recipe, missing)}` gets them:")
    return [
        *lines,
        *(f"  {name}: {listed({name: slots}, store)}" for name, slots in missing.items()),
    ]
