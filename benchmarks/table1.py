"""The paper's Table 1 at equal inference count: whole images against the two stages.

python -m benchmarks.table1 --matcher sift --out DIR [-- --train-dir DIR --pairs-per-scene 10 ...]

All units have one matcher. The layouts become recipes in OUT. `validate --compare` compares them,
with the options after ``--``. Recipes share a journal, so that common units run once. After a kill,
rerun the command to resume.
"""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import main as mkpc

LONG_SIDES = {  # in the order of use; all differ, since equal sizes would give equal matches
    "sift": (1536, 1280, 1024, 1440, 1152, 1664),
    "aliked": (1024, 832, 640, 928, 736, 1120),
    "xfeat_lighterglue": (1024, 1280, 800, 1152, 896, 1408),
}
MORE = {"sift": ", max_matches = 8000"}  # its number of keypoints
LAYOUTS = {  # numbers of units on whole images and on critical regions
    "three": (3, 0),
    "one + two": (1, 2),
    "two + one": (2, 1),
    "six": (6, 0),
    "three + three": (3, 3),
}
# In each, the others are compared with the first.
CONTRASTS = (("three", "one + two", "two + one"), ("six", "three + three"))


def recipe(matcher: str, layout: str) -> str:
    """Return the recipe of a layout as TOML; each pair's F is by MAGSAC alone."""
    whole, crops = LAYOUTS[layout]
    stages = (1,) * whole + (2,) * crops
    sides = LONG_SIDES[matcher][: len(stages)]
    more = MORE.get(matcher, "")
    units = []
    for stage, side in zip(stages, sides, strict=True):
        settings = f'stage = {stage}, matcher = "{matcher}", long_side = {side}{more}'
        units.append(f"{{ {settings} }}")
    return f"units = [{', '.join(units)}]\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--matcher", choices=list(LONG_SIDES), required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("options", nargs="*")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for layout in LAYOUTS:
        (given.out / f"{layout}.toml").write_text(recipe(given.matcher, layout), encoding="utf-8")
    status = 0
    for layouts in CONTRASTS:
        files = [str(given.out / f"{layout}.toml") for layout in layouts]
        command = ["validate", "--compare", *files, "--work-dir", str(given.out)]
        status |= mkpc([*command, *given.options])
    return status


if __name__ == "__main__":
    raise SystemExit(main())
