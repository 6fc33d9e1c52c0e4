"""The verdict on a run: each of its sentences has an input on which it speaks, and one on which it
does not.
"""

import ast
import inspect
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from run_tables import Described, tables_of

from mkpc_kaggle.engine.console import Event, EventKind
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.store.tables import NO_CAMERAS, About, SceneRecord
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.reporting import contradictions, verdict
from mkpc_kaggle.reporting.contradictions import file_labels
from mkpc_kaggle.reporting.run_log import RunLog
from mkpc_kaggle.reporting.summary import facts, weakest_line
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.models import (
    HARDLY_MOVED,
    MAX_CENTRE_SIGMA,
    MAX_SIGMA_IMAGES,
    Comparison,
    DistortedLens,
    DistortionContradiction,
    FocalContradiction,
    FocalSource,
    RegisteredImage,
    SfmModel,
    Sigmas,
)
from mkpc_kaggle.scene.view_graph import BatchImage

NAMES = [f"{number}.jpg" for number in range(4)]
GOOD = Sigmas(0.1, 0.019, 1.0)
RADIAL = KnownCamera("SIMPLE_RADIAL", (575.0, 320.0, 213.5, -0.05), 5.0)
# A pair whose F is good
GOOD_F = {"source": "pair", "support": MIN_SUPPORT}
PAIR = Described("a", (NAMES[0], NAMES[1]), "set", **GOOD_F)
WEAK = Described("a", (NAMES[0], NAMES[1]), "set", source="pair", support=MIN_SUPPORT - 0.1)


def model(
    *sigmas: Sigmas | tuple[()], names: list[str] = NAMES, comparison: Comparison | None = None
) -> SfmModel:
    """Return a model of images with these sigmas."""
    images = []
    for name, each in zip(names, sigmas, strict=True):
        pose = Camera(np.diag([575.0, 575, 1]), np.eye(3), np.zeros(3))
        images.append(RegisteredImage(BatchImage(name, name, Size(640, 427)), pose, 50, each))
    found = SfmModel(tuple(images), np.zeros((0, 3)), 0.5)
    return replace(found, comparison=comparison or Comparison())


def scene(*models: SfmModel, failure: str = "") -> SceneRecord:
    registered = sum(len(each.images) for each in models)
    return SceneRecord("set", len(NAMES), registered, failure=failure, models=models)


def log(
    *scenes: SceneRecord,
    pairs: tuple[Described, ...] = (),
    ending: str = Ending.COMPLETE,
    faults: tuple[str, ...] = (),
) -> RunLog:
    events = [Event(1.0, EventKind.FAULT, text) for text in faults]
    events.append(Event(2.0, EventKind.END, str(ending)))
    recipe = Recipe((Unit(1, "sift", 640),))
    return RunLog(Path("journal"), About(), recipe, tables_of(*pairs), tuple(events), (), scenes)


ALL = tuple(Described(name, (first, name), "set", **GOOD_F) for first, name in pairwise(NAMES))
GOOD_MODEL = model(GOOD, GOOD, GOOD, GOOD)
FEW = Described("few", (NAMES[2], NAMES[3]), "set", matches=20, inliers=7, **GOOD_F)


UNREADABLE = tuple(
    Described(name, (NAMES[0], name), "set", failure=f"{name}: {reason}")
    for name, reason in {
        NAMES[3]: "the file is empty",
        "b.jpg": "no such file",
        "c.jpg": "no such file",
        "d.jpg": "no such file",
    }.items()
)


def of_files(run: RunLog, **files: list[str]) -> RunLog:
    """A run of folders with these images, whose contents are their names."""
    digests = {name: name for name in NAMES}
    return replace(run, about=replace(run.about, files=files), digests=digests)


def compared(*found: FocalContradiction | DistortedLens) -> RunLog:
    focals = tuple(each for each in found if isinstance(each, FocalContradiction))
    lenses = tuple(each for each in found if isinstance(each, DistortedLens))
    comparison = Comparison(focals, lenses)
    return log(scene(model(GOOD, GOOD, GOOD, GOOD, comparison=comparison)))


def distorted(found: DistortionContradiction) -> RunLog:
    comparison = Comparison(distortions=(found,))
    return log(scene(model(GOOD, GOOD, GOOD, GOOD, comparison=comparison)))


# Each sentence, with a run on which it speaks
SPEAKS = {
    "the run failed: no worker left": log(ending=Ending.NO_WORKER),
    "the run failed: 1 of 1 pair got no F because of errors": log(
        pairs=(Described(error="out of memory"),)
    ),
    "not reached in time: 1 pair; give": log(pairs=(Described(failure=None),)),
    "with the fallback: 1 pair; the reasons": log(pairs=(Described(failure="too few"),)),
    "1 pair may show different things": log(pairs=(WEAK,)),
    f"no cameras, {NO_CAMERAS}: photographs that overlap more": log(scene(failure=NO_CAMERAS)),
    f"no cameras, {NO_CAMERAS}: all masks are black": log(
        scene(failure=NO_CAMERAS), faults=("set: all masks are black",)
    ),
    "no cameras, too few pairs: photographs that overlap more": log(scene(failure="too few pairs")),
    "no cameras: the camera hardly moved: nothing can be triangulated; step aside": log(
        scene(failure=HARDLY_MOVED)
    ),
    "the cameras are not to be trusted: the camera hardly moved": log(
        scene(model(GOOD, GOOD, GOOD, GOOD, comparison=Comparison(has_moved=False)))
    ),
    "no camera for 3.jpg: add photographs between": log(
        scene(model(GOOD, GOOD, GOOD, names=NAMES[:3])), pairs=ALL
    ),
    "no camera for 3.jpg: the masks hide everything: 3.jpg": log(
        scene(model(GOOD, GOOD, GOOD, names=NAMES[:3])),
        pairs=ALL,
        faults=("set: the masks hide everything: 3.jpg",),
    ),
    # Another image, whose name contains this one's
    "no camera for 3.jpg, 33.jpg: /d/33.jpg: the file is empty; add photographs between": log(
        scene(model(GOOD, GOOD, GOOD, names=NAMES[:3])),
        pairs=(
            *ALL,
            Described("33", (NAMES[0], "33.jpg"), "set", failure="/d/33.jpg: the file is empty"),
        ),
    ),
    "no camera for 3.jpg, 33.jpg: the photographs are overexposed, 60 % of 33.jpg is white: 33.jpg; 1 of 2 "
    "files were read; add photographs between": log(
        scene(model(GOOD, GOOD, GOOD, names=NAMES[:3])),
        pairs=(*ALL, Described("33", (NAMES[0], "33.jpg"), "set")),
        faults=(
            "set: the photographs are overexposed, 60 % of 33.jpg is white: 33.jpg; 1 of 2 files were read",
        ),
    ),
    "no pair has e.jpg, f.jpg: no other image resembles these, or --pairs omits them; add": of_files(
        log(scene(GOOD_MODEL), pairs=ALL), set=[*NAMES, "e.jpg", "f.jpg"]
    ),
    "other: no cameras, 0 pairs: at least three matched images are needed": replace(
        of_files(log(scene(GOOD_MODEL), pairs=ALL), set=NAMES, other=["o.jpg"]),
        recipe=Recipe((Unit(1, "sift", 640),), scene=SceneConfig(pairs_per_image=0.0)),
    ),
    "3.jpg: the file is empty; b.jpg: no such file; c.jpg: no such file; 1 more cannot be read": log(
        scene(model(GOOD, GOOD, GOOD, names=NAMES[:3])),
        pairs=(*ALL, *UNREADABLE),
    ),
    "alone: no cameras, 1 pair: at least three matched images are needed": replace(
        log(pairs=(Described("alone", NAMES[:2], "alone"),)),
        recipe=Recipe((Unit(1, "sift", 640),), scene=SceneConfig(pairs_per_image=0.0)),
    ),
    "the images form 2 models of 4, 4: add photographs that connect them": (
        log(scene(GOOD_MODEL, GOOD_MODEL))
    ),
    "between 2.jpg and 3.jpg (7 inliers) for example": replace(
        log(
            scene(
                model(GOOD, GOOD, GOOD, names=NAMES[:3]),
                model(GOOD, GOOD, GOOD, names=NAMES[3:] * 3),
            ),
            pairs=(FEW,),
        ),
        digests={name: name for name in NAMES},
    ),
    "a model of 4 cameras hangs together loosely: its cameras are unknown to within 26 % of": log(
        scene(model(*[Sigmas(0.1, 0.26, 1.0)] * 4))
    ),
    "are unknown to within any distance; add": log(scene(model((), (), (), GOOD))),
    "uncertain cameras: 1.jpg; add": log(scene(model(GOOD, Sigmas(0.1, 0.051, 1), GOOD, GOOD))),
    "uncertain cameras: 0.jpg; add": log(scene(model((), GOOD, GOOD, GOOD))),
    "the focal length of 287 px in --intrinsics contradicts the photographs, which fit 575 px": (
        compared(FocalContradiction(FocalSource.INTRINSICS, ("0.jpg",), 287.4, 574.9))
    ),
    "the focal length of 912 px that photographs share contradicts some of them, which fit about 684 px": (
        compared(FocalContradiction(FocalSource.SHARED, ("0.jpg",), 912.2, 684.0))
    ),
    "fx and fy of 552 and 598 px in --intrinsics contradict the photographs, which fit 575 and 576 px": (
        compared(
            FocalContradiction(
                FocalSource.INTRINSICS, ("0.jpg",), 575.0, 575.5, (552.0, 598.0), (575.0, 576.0)
            )
        )
    ),
    "the focal length of 1150 px in EXIF contradicts the photographs, which fit 575 px: 0.jpg; the": (
        compared(FocalContradiction(FocalSource.EXIF, ("0.jpg",), 1150.0, 575.0))
    ),
    "the distortion of 4.5 % at the edge in --intrinsics contradicts the photographs, which fit -1.5 %": (
        distorted(DistortionContradiction(tuple(NAMES), 0.0454, -0.0154, RADIAL))
    ),
    "0.jpg, 1.jpg, 2.jpg and 1 more; correct or remove the row. The parameters 575 320 213.5 -0.05 of": (
        distorted(DistortionContradiction(tuple(NAMES), 0.0454, -0.0154, RADIAL))
    ),
    "the lens of 4 photographs is distorted by 1.5 % at the edge": compared(
        DistortedLens(tuple(NAMES), -0.0154, RADIAL)
    ),
    "add --set scene.camera_model=SIMPLE_RADIAL to `mkpc reconstruct`, or --intrinsics": compared(
        DistortedLens(tuple(NAMES), -0.0154, RADIAL)
    ),
    # The report of `submit` has the same sentence, and `submit` refuses such cameras.
    "for `mkpc submit`, undistort the photographs": compared(
        DistortedLens(tuple(NAMES), -0.0154, RADIAL)
    ),
    "the row *,SIMPLE_RADIAL,575 320 213.5 -0.05,5": compared(
        DistortedLens(tuple(NAMES), -0.0154, RADIAL)
    ),
    "the row 0.jpg,SIMPLE_RADIAL,575 320 213.5 -0.05,5, and the same for the others": compared(
        DistortedLens(tuple(NAMES[:3]), -0.0154, RADIAL)
    ),
}


@pytest.mark.parametrize("text", SPEAKS)
def test_each_sentence_speaks_on_its_input(text):
    problems = verdict.verdict(SPEAKS[text]).problems
    assert any(text in problem for problem in problems), problems


def test_a_run_without_an_end_is_at_work_or_was_killed():
    assert replace(log(), events=()).ending == "not ended (at work, or killed)"


def test_a_run_without_problems_looks_right():
    for run in (log(pairs=ALL), log(scene(GOOD_MODEL), pairs=ALL)):
        assert verdict.verdict(run).problems == ()
        assert str(verdict.verdict(run)).endswith("nothing looks wrong")


def test_images_in_no_pair_count_and_so_do_copies():
    copy = Described("copy", (NAMES[0], "copy.jpg"), "set", **GOOD_F)
    run = log(scene(GOOD_MODEL), pairs=(*ALL, copy))
    assert verdict.verdict(run).text.startswith("4 of 4 images with a camera")
    run = of_files(run, set=[*NAMES, "copy.jpg", "e.jpg"], other=["o.jpg"])
    run = replace(run, digests=run.digests | {"copy.jpg": NAMES[0]})
    assert verdict.verdict(run).text.startswith("5 of 7 images with a camera")
    assert ("images with a camera", "5 of 7", "in 1 batch") in [*facts(run)]
    table = verdict.summary_table(run)
    assert [table["scenes"][0][key] for key in ("images", "cameras")] == [6, 5]
    assert table["files"] == {
        "set": {"count": 6, "in_no_pair": ["e.jpg"]},
        "other": {"count": 1, "in_no_pair": ["o.jpg"]},
    }


def test_cameras_of_a_model_that_is_too_large_for_sigmas_are_not_called_uncertain():
    count = MAX_SIGMA_IMAGES + 1
    names = [f"{number}.jpg" for number in range(count)]
    large = model(*[()] * count, names=names)
    assert verdict.verdict(log(scene(large))).problems == ()


def test_the_doubts_about_a_pair_have_inputs():
    contradicting = Described(choice=Reason.CONTRADICTION, **GOOD_F)
    weak, contradicts, none = verdict.doubts(tables_of(WEAK, contradicting, PAIR).pairs)
    assert "times the inliers by chance" in weak
    assert contradicts == "its matches contradict the cameras"
    assert none == ""


def sentences(module: object) -> list[str]:
    """Return the texts that functions of a module yield or return, as regular expressions."""
    patterns = []
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        value = node.value if isinstance(node, ast.Yield | ast.Return) else None
        if not isinstance(value, ast.JoinedStr):
            continue
        parts = [
            re.escape(str(part.value)) if isinstance(part, ast.Constant) else ".*"
            for part in value.values
        ]
        pattern = "".join(parts)
        # Sentences, and not names of files or lists of them
        if pattern.count("\\ ") >= 3:
            patterns.append(pattern)
    return patterns


def test_no_sentence_of_the_verdict_lacks_an_input():
    """A threshold outside the range of its quantity would never speak, and nobody would notice."""
    said = [problem for run in SPEAKS.values() for problem in verdict.verdict(run).problems]
    patterns = [*sentences(verdict), *sentences(contradictions)]
    assert len(patterns) >= 10
    doubts = "its matches contradict", "times the inliers by chance"
    missing = [
        pattern
        for pattern in patterns
        if not any(re.search(pattern, text) for text in said)
        and not any(re.escape(text) in pattern for text in doubts)
    ]
    assert missing == []


def test_images_with_equal_file_names_are_called_by_their_folders():
    assert file_labels(["a/1.jpg", "b/1.jpg", "b/2.jpg"]) == {
        "a/1.jpg": "a/1.jpg",
        "b/1.jpg": "b/1.jpg",
        "b/2.jpg": "2.jpg",
    }
    names = ["a/1.jpg", "b/1.jpg", "b/2.jpg", "c/1.jpg"]
    pairs = tuple(
        Described(name, (first, name), "set", **GOOD_F) for first, name in pairwise(names)
    )
    uncertain = Sigmas(0.1, MAX_CENTRE_SIGMA * 2, 1)
    run = log(scene(model(uncertain, GOOD, GOOD, names=names[:3])), pairs=pairs)
    problems = verdict.verdict(run).problems
    assert problems[0].startswith("no camera for c/1.jpg: ")
    assert problems[1].startswith("uncertain cameras: a/1.jpg; ")
    (line,) = weakest_line(run.scenes)
    assert "error of the centre: a/1.jpg (" in line
    assert "2.jpg (" in line
    assert "b/2.jpg" not in line
