"""How many of 10,000 pairs each recipe does in 8 h 45 min, from the measured seconds.

A unit on whole images is counted with one new image a pair, since pairs are visited in an order in
which the other image is cached; a unit on crops with two. Decoding, estimates and scenes run on the
processor at the same time, and are not counted. Two GPUs are counted as twice one.
"""

from benchmarks.gpu.record import Part, Row, SkippedError
from benchmarks.gpu.setup import Setup
from benchmarks.gpu.speed import QUICK_RECIPES, RECIPES, Case
from mkpc_kaggle.recipe import Unit, load_recipe

PAIRS = 10_000
SECONDS = 8.75 * 3600


def measure(part: Part, setup: Setup, speed: Part) -> None:
    """Add a row for each recipe and precision."""
    # A row without seconds has an error.
    costs = {(row["matcher"], row["precision"]): row for row in speed.rows if "new" in row}
    if not costs:
        raise SkippedError("no seconds were measured")
    if setup.quick:
        part.reason = "a rehearsal's seconds are those of small views"
    for recipe_name in QUICK_RECIPES if setup.quick else RECIPES:
        recipe = load_recipe(recipe_name)
        for precision in ("float32", "float16"):
            seconds = []
            for unit in recipe.units:
                name = Case.of(recipe, unit).name
                # RootSIFT has no network, and the same cost in each precision.
                cost = costs.get((name, precision)) or costs.get((name, "float32"))
                if cost is not None:
                    seconds.append(_seconds(unit, cost))
            part.add(
                recipe=recipe_name,
                precision=precision,
                **_forecast(seconds, len(recipe.units)),
            )


def _seconds(unit: Unit, cost: Row) -> float:
    images = 2 if unit.stage == 2 else 1
    return float(cost["encode"]) / 2 * images + float(cost["cached"])


def _forecast(seconds: list[float], units: int) -> Row:
    """Return the seconds of a pair, and the number of pairs; empty if a unit was not measured."""
    row: Row = {"units measured": f"{len(seconds)} of {units}"}
    if len(seconds) < units:
        return row
    total = sum(seconds)
    row["seconds a pair"] = total
    for gpus in (1, 2):
        row[f"pairs, {gpus} GPU{'s' * (gpus > 1)}"] = min(PAIRS, int(gpus * SECONDS / total))
    row["hours for all, 1 GPU"] = PAIRS * total / 3600
    return row
