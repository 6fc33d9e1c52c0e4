"""The layer's face: a batch in, cameras and the pairs' choices out; plain values that go through a pipe."""

from dataclasses import dataclass, replace

from mkpc_kaggle.scene.batch import Batch, BatchImage, Edge, distinct_images, edges_of, matchers_of
from mkpc_kaggle.scene.checks import believable
from mkpc_kaggle.scene.choose import Choice, Reason, choose
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.graph import Component, components
from mkpc_kaggle.scene.keypoints import scene_keypoints
from mkpc_kaggle.scene.known_focals import KnownFocals
from mkpc_kaggle.scene.model import Model, PlacedImage, Scene
from mkpc_kaggle.scene.one_camera import OneCameras, one_cameras


@dataclass(frozen=True, eq=False)
class Solution:
    """What is known of a batch: its scenes, and for each of its pairs, in order, which F it gets.

    The scenes are those of all matches together; what single matchers' matches gave is in the choices alone.

    Images go by the name under which they came first; ``names`` has that of every other name too.
    """

    scenes: tuple[Scene, ...]
    choices: tuple[Choice, ...]
    names: tuple[tuple[str, str], ...]

    def placed(self, name: str) -> PlacedImage | None:
        """The camera of an image in the largest model that has it."""
        first = dict(self.names)[name]
        found = [image for model in models_of(self.scenes) for image in model.images if image.name == first]
        return found[0] if found else None


def solve(batch: Batch, config: SceneConfig, known_focals: KnownFocals | None = None) -> Solution:
    """Reconstruct every connected component of a batch, and choose an F for each pair.

    With ``known_focals``, pairs that get no F from their cameras are estimated anew where a focal length is known.
    Whatever the matches are, the answer is a :class:`Solution`: what could not be had has a reason. It takes
    seconds to minutes and may end the process, see :mod:`mkpc_kaggle.scene.reconstruct`.
    """
    images = distinct_images(batch.images)
    first = {image.digest: image for image in images}
    image_of = {image.name: first[image.digest] for image in batch.images}
    scenes, known = scenes_and_cameras(images, edges_of(batch), config)
    matchers = matchers_of(batch) if config.each_matcher else ()
    single = matchers if len(matchers) > 1 else ()
    alone = [scenes_of(images, edges_of(batch, name), config, known) for name in single]
    reconstructions = [models_of(found) for found in (scenes, *alone)]
    models = [model for found in reconstructions for model in found]
    choices = []
    for pair in batch.pairs:
        image0, image1 = image_of[pair.image0], image_of[pair.image1]
        choice = choose(reconstructions, image0.name, image1.name, pair.matches, pair.own, config)
        if known_focals is not None and choice.reason not in (Reason.SCENE, Reason.SAME_IMAGE):
            choice = replace(choice, F=known_focals.fundamental(models, known, image0, image1, pair.matches))
        choices.append(choice)
    names = tuple((name, image.name) for name, image in image_of.items())
    return Solution(scenes, tuple(choices), names)


def scenes_and_cameras(
    images: tuple[BatchImage, ...], edges: tuple[Edge, ...], config: SceneConfig
) -> tuple[tuple[Scene, ...], OneCameras]:
    """The reconstruction of each connected component, and the cameras that took several images of it.

    What looks like one camera's is reconstructed anew as such; if images see fewer points then, it was not.
    """
    scenes = scenes_of(images, edges, config, {})
    known = one_cameras(images, models_of(scenes), config)
    if known:
        anew = scenes_of(images, edges, config, known)
        if observations(anew) >= config.one_camera_points * observations(scenes):
            return anew, known
    return scenes, {}


def observations(scenes: tuple[Scene, ...]) -> int:
    """How often images see points."""
    return sum(image.points for model in models_of(scenes) for image in model.images)


def scenes_of(
    images: tuple[BatchImage, ...], edges: tuple[Edge, ...], config: SceneConfig, known: OneCameras
) -> tuple[Scene, ...]:
    """The reconstruction of each connected component."""
    found = components(len(images), edges, config.least_inliers)
    return tuple(scene_of(component, images, config, known) for component in found)


def scene_of(
    component: Component, images: tuple[BatchImage, ...], config: SceneConfig, known: OneCameras
) -> Scene:
    """The reconstruction of one component, or why there is none."""
    members = [images[place] for place in component.images]
    names = tuple(image.name for image in members)
    if len(members) < config.least_images:
        return Scene(names, failure=f"{len(members)} images are connected; a scene needs {config.least_images}")
    if len(component.edges) < config.least_pairs_per_image * len(members):
        few = f"{len(component.edges)} pairs connect {len(members)} images"
        return Scene(names, failure=f"{few}; a scene needs {config.least_pairs_per_image:g} an image")
    keypoints = scene_keypoints(len(members), component.edges, config.cell)
    try:
        from mkpc_kaggle.scene.reconstruct import reconstruct

        found = reconstruct(names, [image.size for image in members], keypoints, config, known)
    except ImportError as error:
        return Scene(names, failure=f"pycolmap cannot be imported: {error}")
    except (RuntimeError, ValueError) as error:
        return Scene(names, failure=f"pycolmap failed: {error}")
    models, doubts = believable(found, config)
    return Scene(names, models, doubts, "" if models else "no believable model came of the matches")


def models_of(scenes: tuple[Scene, ...]) -> tuple[Model, ...]:
    return tuple(model for scene in scenes for model in scene.models)
