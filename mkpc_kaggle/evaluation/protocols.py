"""Settings of published evaluations: SuperGlue's on YFCC100M and ScanNet, and LoFTR's on MegaDepth."""

from dataclasses import replace

from mkpc_kaggle.geometry.robust import Method, RobustConfig
from mkpc_kaggle.recipe import Recipe

RUN = RobustConfig(Method.RANSAC, 1.0, 0.99999, max_iterations=1000, permutations=1, every_match=True)
PROTOCOLS = {"superglue": RUN, "loftr": replace(RUN, threshold=0.5)}


def by_protocol(recipe: Recipe, protocol: str) -> Recipe:
    """Return the recipe with the settings of a protocol. A protocol also scores rotations ``in_front``.

    SuperGlue's threshold is in pixels of the resized picture, here the recipe's largest in stage 1.
    """
    units = tuple(replace(unit, antialias=False) for unit in recipe.units)
    sides = [unit.long_side or max(map(int, unit.area.split("x"))) for unit in units if unit.stage == 1]
    magsac = replace(PROTOCOLS[protocol], threshold_side=max(sides) if protocol == "superglue" else 0)
    return replace(recipe, units=units, magsac=magsac, focal=None, scene=None)
