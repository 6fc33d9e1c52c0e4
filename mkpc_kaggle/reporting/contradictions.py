"""Sentences about what the photographs of a scene contradict, each with its remedy."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from mkpc_kaggle.engine.store.tables import SceneRecord
from mkpc_kaggle.errors import plural
from mkpc_kaggle.scene.models import (
    HARDLY_MOVED,
    DistortedLens,
    DistortionContradiction,
    FocalContradiction,
    FocalSource,
)

MAX_NAMED = 3  # images in a sentence
Labels = Mapping[str, str]  # what to call each image in a sentence


def contradictions(scene: SceneRecord) -> Iterator[str]:
    """Yield a sentence for each assumption that the photographs of a scene contradict."""
    if not has_moved(scene):
        yield f"the cameras are not to be trusted: {HARDLY_MOVED}"
        # Without depth, focal lengths and distortion are not determined.
        return
    labels = labels_of(scene)
    for model in scene.models:
        for focal in model.comparison.focals:
            yield _focal_sentence(focal, labels)
        for distortion in model.comparison.distortions:
            yield _distortion_sentence(distortion, labels)
        for lens in model.comparison.lenses:
            # The model has an adopted lens, so nothing contradicts it.
            if not lens.is_adopted:
                is_everything = len(lens.images) == scene.images
                yield _lens_sentence(lens, labels, is_everything=is_everything)


def adopted_lenses(scenes: Sequence[SceneRecord]) -> Iterator[tuple[str, str, str]]:
    """Yield a fact on each lens with distortion that the photographs have shown."""
    for scene in scenes:
        labels = labels_of(scene)
        for model in scene.models:
            for lens in filter(lambda lens: lens.is_adopted, model.comparison.lenses):
                names = named([labels[name] for name in lens.images])
                k = lens.camera.distortion[0]
                remark = (
                    f"{100 * abs(lens.displacement):.1f} % at the edge; images/ and sparse/ are "
                    f"undistorted: {names}"
                )
                yield (
                    "distorted lens",
                    f"{lens.camera.model}, f = {lens.camera.focal:.1f}, k = {k:.4f}",
                    remark,
                )


def has_moved(scene: SceneRecord) -> bool:
    """Return whether the cameras of a scene, if it has any, were at different places."""
    return not scene.models or scene.models[0].comparison.has_moved


def _focal_sentence(found: FocalContradiction, labels: Labels) -> str:
    images = named([labels[name] for name in found.images])
    if found.given_axes:
        given = " and ".join(f"{value:.0f}" for value in found.given_axes)
        fitted = " and ".join(f"{value:.0f}" for value in found.fitted_axes)
        return (
            f"fx and fy of {given} px in --intrinsics contradict the photographs, which fit {fitted} px: "
            f"{images}; correct or remove the row"
        )
    if found.source is FocalSource.INTRINSICS:
        return (
            f"the focal length of {found.given:.0f} px in --intrinsics contradicts the photographs, which "
            f"fit {found.fitted:.0f} px: {images}; correct or remove the row"
        )
    if found.source is FocalSource.SHARED:
        return (
            f"the focal length of {found.given:.0f} px that photographs share contradicts some of them, which "
            f"fit about {found.fitted:.0f} px: {images}; omit --camera folder"
        )
    return (
        f"the focal length of {found.given:.0f} px in EXIF contradicts the photographs, which fit "
        f"{found.fitted:.0f} px: {images}; the cameras have the latter. If they look wrong, give "
        "`mkpc reconstruct` --intrinsics, or remove the focal length from EXIF"
    )


def _distortion_sentence(found: DistortionContradiction, labels: Labels) -> str:
    images = named([labels[name] for name in found.images])
    parameters = " ".join(f"{value:.5g}" for value in found.camera.parameters)
    return (
        f"the distortion of {100 * found.given:.1f} % at the edge in --intrinsics contradicts the photographs, "
        f"which fit {100 * found.fitted:.1f} %: {images}; correct or remove the row. The parameters "
        f"{parameters} of {found.camera.model} fit"
    )


def _lens_sentence(found: DistortedLens, labels: Labels, *, is_everything: bool) -> str:
    camera = found.camera
    parameters = " ".join(f"{value:.5g}" for value in camera.parameters)
    first = "*" if is_everything else found.images[0]
    others = "" if is_everything or len(found.images) == 1 else ", and the same for the others"
    images = named([labels[name] for name in found.images])
    return (
        f"the lens of {plural(len(found.images), 'photograph')} is distorted by "
        f"{100 * abs(found.displacement):.1f} % at the edge, and neither the cameras nor their expected errors "
        f"include that: {images}; add --set scene.camera_model={camera.model} to `mkpc reconstruct`, or "
        f"--intrinsics with the row {first},{camera.model},{parameters},{camera.sigma:g}{others}. F has no "
        "distortion: for `mkpc submit`, undistort the photographs"
    )


def labels_of(scene: SceneRecord) -> dict[str, str]:
    """Return :func:`file_labels` of the images with a camera of a scene."""
    return file_labels(found.image.name for model in scene.models for found in model.images)


def file_labels(names: Iterable[str]) -> dict[str, str]:
    """Return what to call each image in a sentence: its file name, or the whole name if another image has
    the same file name.
    """
    distinct = set(names)
    counts = Counter(Path(name).name for name in distinct)
    return {name: Path(name).name if counts[Path(name).name] == 1 else name for name in distinct}


def named(names: Sequence[str]) -> str:
    """Return up to ``MAX_NAMED`` names and the number of the others."""
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")
