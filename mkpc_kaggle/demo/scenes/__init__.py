"""The scenes by name."""

from collections.abc import Callable
from types import MappingProxyType

import numpy as np

from mkpc_kaggle.demo.photographs import Photographs
from mkpc_kaggle.demo.scene import Scene, in_units
from mkpc_kaggle.demo.scenes.courtyard import courtyard
from mkpc_kaggle.demo.scenes.gallery import gallery
from mkpc_kaggle.demo.scenes.street import street

# A builder and the metres per unit of the world it is written out in.
_BUILDERS: MappingProxyType[str, tuple[Callable[[np.random.Generator, Photographs], Scene], float]] = (
    MappingProxyType({"courtyard": (courtyard, 2.5), "gallery": (gallery, 1.0), "street": (street, 1.0)})
)

SCENE_NAMES: tuple[str, ...] = tuple(_BUILDERS)


def build_scene(name: str, photographs: Photographs, *, seed: int = 0, image_scale: float = 1.0) -> Scene:
    """One scene; what it looks like depends on its name and the seed alone, never on the other scenes.

    Raises ValueError for an unknown name.
    """
    if name not in _BUILDERS:
        raise ValueError(f"unknown scene {name!r}; there are {', '.join(SCENE_NAMES)}")
    builder, metres_per_unit = _BUILDERS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    return in_units(builder(rng, photographs), metres_per_unit, image_scale)
