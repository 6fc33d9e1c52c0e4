"""The command ``match``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.errors import plural
from mkpc_kaggle.pipeline.arguments import as_image
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.reporting.figures import require_format, save

HELP = """\
Match two images. Print the fundamental matrix F (x1^T F x0 = 0, pixel centres at integers), the
number of matches of each unit, and the critical regions. Points are in pixels of the stored
files, without the EXIF orientation; figures are upright. --out draws the matches and the critical
regions.

Exit status: 0 done, 1 every unit failed, 2 bad input.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image0", type=Path, help="first image")
    parser.add_argument("image1", type=Path, help="second image")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FIG.png",
        help="draw the pair; the suffix sets the format",
    )
    options.add_matching(parser)


def run(arguments: argparse.Namespace) -> int:
    inputs = [arguments.image0, arguments.image1, *options.recipe_files(arguments.recipe)]
    require_apart({"--out": arguments.out}, inputs, weights=arguments.weights)
    # Before the work: a wrong suffix should not cost minutes of matching.
    if arguments.out is not None:
        require_format(arguments.out)
    images = (as_image(arguments.image0), as_image(arguments.image1))
    # After the images: a wrong path should not wait for weights to be digested.
    matcher = TwoStageMatcher(
        arguments.recipe,
        weights=arguments.weights,
        device=arguments.device,
        precision=arguments.precision,
        settings=options.settings_of(arguments),
    )
    match = matcher(*images)
    print("\n".join(_lines(match, matcher.recipe.name)))
    if arguments.out is not None:
        save(match.plot(*images), arguments.out)
        print(f"figure: {arguments.out}")
    return int(len(match.failures) == len(match.results))


def _lines(match: PairMatch, recipe: str) -> list[str]:
    """Return the result as lines: F, counts, the units, the critical regions."""
    found = match.estimate
    lines = [f"F, by recipe {recipe}; x1^T F x0 = 0 in pixels of the stored files:"]
    lines += [" ".join(f"{value: .9e}" for value in row) for row in found.matrix]
    lines += [f"this is the fallback: {found.failure}"] if found.failure else []
    inliers = plural(found.inlier_count, "inlier")
    lines.append(f"{plural(len(match.matches), 'match')}, {inliers}")
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
