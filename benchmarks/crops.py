"""Where the crop pays: crops against other whole images at equal inference count.

python -m benchmarks.crops --out DIR [--matcher aliked_lightglue] [--layouts NAME ...]
    -- --train-dir DIR --no-scenes [...]

The layouts become recipes in OUT, and `validate --compare` compares them with the first, with the
options after ``--``. All units have one matcher. Recipes share a journal, so that common units run
once. After a kill, rerun the command to resume.
"""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import main as mkpc

MORE = {"sift": ", max_matches = 8000"}  # its number of keypoints
TAIL = """
[magsac]
permutations = 1
[focal]
scale = 0.25
[matchers.sift]
features = 8000
ratio = 0.8
contrast_threshold = 0.02
"""
NO_ENLARGEMENT = ", enlarge = false"
# By name: (stage, long side) of each unit, more keys of the units, the table [mkpc]
LAYOUTS: dict[str, tuple[tuple[tuple[int, int], ...], str, str]] = {
    "one": (((1, 1024),), "", ""),
    **{f"whole {side}": (((1, 1024), (1, side)), "", "") for side in (512, 640, 768, 1280, 1536)},
    "whole 1280 as stored": (((1, 1024), (1, 1280)), NO_ENLARGEMENT, ""),
    "whole 1536 as stored": (((1, 1024), (1, 1536)), NO_ENLARGEMENT, ""),
    **{f"crop {side}": (((1, 1024), (2, side)), "", "") for side in (768, 1024, 1280)},
    "crop as stored": (((1, 1024), (2, 1024)), NO_ENLARGEMENT, ""),
    "crop e 1.15": (((1, 1024), (2, 1024)), "", "expand_x = 1.15\nexpand_y = 1.15"),
    "crop e 1.3": (((1, 1024), (2, 1024)), "", "expand_x = 1.3\nexpand_y = 1.3"),
    "rule": (((1, 1024), (2, 768)), "", 'when = "scale"'),
    "three": (((1, 1024), (1, 1280), (1, 1536)), "", ""),
    "two and crop": (((1, 1024), (1, 1280), (2, 1024)), "", ""),
    "one and two crops": (((1, 1024), (2, 1024), (2, 1280)), "", ""),
}


def recipe(matcher: str, layout: str) -> str:
    """Return the recipe of a layout as TOML."""
    sides, more, mkpc_table = LAYOUTS[layout]
    units = []
    for stage, side in sides:
        keys = f'stage = {stage}, matcher = "{matcher}", long_side = {side}'
        units.append(f"{{ {keys}{MORE.get(matcher, '')}{more} }}")
    return f"units = [{', '.join(units)}]\n[mkpc]\n{mkpc_table}\n{TAIL}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--matcher", default="aliked_lightglue")
    parser.add_argument("--layouts", nargs="+", choices=list(LAYOUTS), default=list(LAYOUTS))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("options", nargs="*")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    files = []
    for layout in given.layouts:
        file = given.out / f"{layout}.toml"
        file.write_text(recipe(given.matcher, layout), encoding="utf-8")
        files.append(str(file))
    command = ["validate", "--compare", *files, "--work-dir", str(given.out)]
    return mkpc([*command, *given.options])


if __name__ == "__main__":
    raise SystemExit(main())
