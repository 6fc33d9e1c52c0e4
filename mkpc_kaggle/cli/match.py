"""The command ``match``."""

import argparse
from functools import partial
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.console import unblocked
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher, to_image
from mkpc_kaggle.reporting.figures import draw_pair, require_format, save

HELP = """\
Match two images. Print the fundamental matrix (x1^T F x0 = 0, pixel centres at integers), the number of matches
of each unit, and the critical regions. --out draws the matches, the clusters and the critical regions. Points are
in pixels of the stored files, without the EXIF orientation; figures are upright.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(printing=partial(unblocked, [2]))  # stderr, where image decoders print warnings
    parser.add_argument("image0", type=Path)
    parser.add_argument("image1", type=Path)
    parser.add_argument("--out", type=Path, metavar="FIG.png", help="draw the pair; the suffix sets the format")
    options.add_matching(parser)


def run(arguments: argparse.Namespace) -> None:
    inputs = [arguments.image0, arguments.image1, Path(arguments.recipe)]
    require_apart({"--out": arguments.out}, inputs, weights=arguments.weights)
    if arguments.out is not None:
        require_format(arguments.out)
    images = to_image(arguments.image0), to_image(arguments.image1)
    given = {name: getattr(arguments, name) for name in ("weights", "device", "precision", "licence")}
    matcher = TwoStageMatcher(arguments.recipe, **given)
    match = matcher(*images)
    found = match.estimate
    lines = [" ".join(f"{value: .9e}" for value in row) for row in found.matrix]
    lines += [f"this is the fallback: {found.failure}"] if found.failure else []
    lines.append(f"{len(match.matches)} matches, {found.inlier_count} inliers")
    verdict = "the images overlap" if found.stats.support >= MIN_SUPPORT else "the images may not overlap"
    lines.append(f"{found.stats.support:.1f} times the inliers expected by chance: {verdict}")
    for result in match.results:
        counts = f"{len(result.matches):>6} matches  {result.seconds:.2f} s  {result.failure or result.note}"
        lines.append(f"  {result.unit.name:<30}{counts}")
    for number, region in enumerate(match.regions or ()):
        box = region.box
        where = f"x {box.left}..{box.right - 1}, y {box.top}..{box.bottom - 1}"
        lines.append(f"image {number}: {region.reason}, {where}")
    print("\n".join(lines))
    if arguments.out is not None:
        save(draw_pair(*images, match, matcher.recipe.mkpc), arguments.out)
        print(f"figure: {arguments.out}")
