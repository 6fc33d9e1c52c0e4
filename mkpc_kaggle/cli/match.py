"""The command ``match``."""

import argparse
from pathlib import Path

import numpy as np

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.hloc import SUFFIX, HlocPair, require_h5py, write_hloc
from mkpc_kaggle.data.outputs import RESULTS, replacing, require_apart
from mkpc_kaggle.errors import UserError, plural, writing
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.pipeline.drawing import draw_pair
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher, as_image
from mkpc_kaggle.progress import announced
from mkpc_kaggle.reporting.figures import require_format, save

HELP = """\
Match two images. Print the fundamental matrix F (x1^T F x0 = 0, pixel centres at integers), the
number of matches of each unit, and the critical regions. Points are in pixels of the stored
files, without the EXIF orientation; figures are upright.

  --out   draws the matches, the clusters and the critical regions.
  --save  writes the arrays points0 and points1 (N x 2), scores (N), inliers (N, true or false)
          and F (3 x 3), for numpy.load. A name that ends in .h5 gets keypoints and matches
          in hloc's layout, under the names of the files

Exit status: 0 done, 1 every unit failed, 2 bad input.
"""


EXIT_NOTHING_RAN = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image0", type=Path, help="first image")
    parser.add_argument("image1", type=Path, help="second image")
    parser.add_argument(
        "--out", type=Path, metavar="FIG.png", help="draw the pair; the suffix sets the format"
    )
    text = "save the points, scores, inliers and F as arrays, or keypoints and matches for hloc"
    parser.add_argument("--save", type=Path, metavar="FILE.npz|FILE.h5", help=text)
    options.add_matching(parser)


def run(arguments: argparse.Namespace) -> int:
    inputs = [arguments.image0, arguments.image1, options.recipe_file(arguments)]
    files = {"--out": arguments.out, "--save": arguments.save}
    require_apart(files, filter(None, inputs), weights=arguments.weights)
    # Before the work: a wrong suffix should not cost minutes of matching.
    if arguments.out is not None:
        require_format(arguments.out)
    if arguments.save is not None:
        if arguments.save.suffix not in RESULTS["--save"]:
            raise UserError(f"--save {arguments.save}: the name must end in .npz or .h5")
        if arguments.save.suffix == SUFFIX:
            require_h5py()
    images = (as_image(arguments.image0), as_image(arguments.image1))
    # After the images: a wrong path should not wait for weights to be digested.
    with announced(f"loading recipe {arguments.recipe}: libraries, and checks of weights"):
        matcher = TwoStageMatcher(
            arguments.recipe,
            weights=arguments.weights,
            device=arguments.device,
            precision=arguments.precision,
            settings=options.settings_of(arguments),
            progress=True,
        )
    match = matcher(*images)
    print("\n".join(_lines(match, matcher.recipe.name)))
    if arguments.out is not None:
        with announced("drawing the figure"):
            save(draw_pair(*images, match, matcher.recipe.mkpc), arguments.out)
        print(f"figure: {arguments.out}")
    if arguments.save is not None:
        with writing(f"--save {arguments.save}"):
            if arguments.save.suffix == SUFFIX:
                save_for_hloc(match, (arguments.image0, arguments.image1), arguments.save)
            else:
                save_arrays(match, arguments.save)
        print(f"arrays: {arguments.save}")
    return EXIT_NOTHING_RAN if _nothing_ran(match) else 0


def save_arrays(match: PairMatch, path: Path) -> None:
    """Write points (N, 2) float32 of both images, scores (N,), inliers (N,) bool and F (3, 3)."""
    matches = match.matches
    path.parent.mkdir(parents=True, exist_ok=True)
    # NumPy needs bytes: ``buffer`` is the binary stream below the text stream.
    with replacing(path) as stream:
        np.savez(
            stream.buffer,
            points0=matches.points0,
            points1=matches.points1,
            scores=matches.scores,
            inliers=match.estimate.inliers,
            F=match.estimate.matrix_or_fallback,
        )


def save_for_hloc(match: PairMatch, files: tuple[Path, Path], path: Path) -> None:
    """Write the keypoints of both images and their matches, of all units, before estimation."""
    names = tuple(file.name for file in files)
    if names[0] == names[1]:
        names = tuple(str(file).lstrip("/") for file in files)
    found = match.keypoints
    points = (found.points0, found.points1)
    indices = found.indices
    # Each match of a matcher without keypoints is a separate keypoint.
    if (indices < 0).any():
        points = (match.matches.points0, match.matches.points1)
        indices = np.column_stack([np.arange(len(match.matches))] * 2)
    pair = HlocPair(names[0], names[1], indices, match.matches.scores)
    sizes = dict(zip(names, match.sizes, strict=True))
    write_hloc(path, dict(zip(names, points, strict=True)), sizes, [pair])


def _nothing_ran(match: PairMatch) -> bool:
    return len(match.failures) == len(match.results)


def _lines(match: PairMatch, recipe: str) -> list[str]:
    """Return the result as lines: F, counts, the units, the critical regions."""
    found = match.estimate
    lines = [f"F, by recipe {recipe}; x1^T F x0 = 0 in pixels of the stored files:"]
    lines += [" ".join(f"{value: .9e}" for value in row) for row in found.matrix_or_fallback]
    lines += [f"this is the fallback: {found.failure}"] if found.failure else []
    inliers = plural(found.inlier_count, "inlier")
    lines.append(f"{plural(len(match.matches), 'match')}, {inliers}")
    if not _nothing_ran(match):  # failed units say nothing of the images
        verdict = "the images may not overlap"
        if found.stats.support >= MIN_SUPPORT:
            verdict = "the images overlap"
        lines.append(f"{found.stats.support:.1f} times the inliers expected by chance: {verdict}")
    for result in match.results:
        counts = f"{plural(len(result.matches), 'match'):>14}  {result.seconds:.2f} s"
        remark = result.failure or result.note or (str(result.need) if result.need else "")
        lines.append(f"  {result.unit.name:<30}{counts}  {remark}".rstrip())
    for number, region in enumerate(match.regions or ()):
        box = region.box
        # The last column and row of the box, as a person counts them.
        where = f"x {box.left}..{box.right - 1}, y {box.top}..{box.bottom - 1}"
        lines.append(f"image {number}: critical region {where} ({region.reason})")
    return lines
