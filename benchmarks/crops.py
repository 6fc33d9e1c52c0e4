"""Where the crop pays: crops against other whole images at equal inference count.

python -m benchmarks.crops --out DIR [--matcher aliked_lightglue] [--layouts NAME ...]
    -- --train-dir DIR --no-scenes [...]

The layouts become recipes in OUT, and `validate` runs them on the same pairs with the options after
``--``. All units have one matcher; with --rootsift, RootSIFT's unit of `light` runs before them, so
that the layout "rule" is `light`.
Recipes share a journal, so that common units run once. After a kill, rerun the command to resume.

The last tables have the gain of the last layout over each other one: for all scenes, for those of
one change of scale (SCENE_zoomN), for those whose names start with --chosen, on which the rule was
chosen, and for the others. The gain is in mAA.
"""

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any, TypeAlias

from mkpc_kaggle.cli import main as mkpc
from mkpc_kaggle.evaluation.validate import Paired, paired_difference

Run: TypeAlias = dict[str, Any]  # the figures of `validate --json`

MORE = {"sift": ", max_matches = 8000"}  # its number of keypoints
TAIL = """
[magsac]
[focal]
scale = 0.25
[matchers.sift]
features = 8000
ratio = 0.8
contrast_threshold = 0.02
"""
# Of the recipe `light`.
ROOTSIFT = '{ stage = 1, matcher = "sift", long_side = 1536, max_matches = 8000 }'
NO_ENLARGEMENT = ", enlarge = false"
# By name: (stage, long side) of each unit, more keys of the units, the table [mkpc]
LAYOUTS: dict[str, tuple[tuple[tuple[int, int], ...], str, str]] = {
    "one": (((1, 1024),), "", ""),
    **{
        f"whole {side}": (((1, 1024), (1, side)), "", "")
        for side in (512, 640, 768, 1280, 1536)
    },
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


def recipe(matcher: str, layout: str, *, rootsift: bool = False) -> str:
    """Return the recipe of a layout as TOML."""
    sides, more, mkpc_table = LAYOUTS[layout]
    units = [ROOTSIFT] if rootsift else []
    for stage, side in sides:
        keys = f'stage = {stage}, matcher = "{matcher}", long_side = {side}'
        units.append(f"{{ {keys}{MORE.get(matcher, '')}{more} }}")
    return f"units = [{', '.join(units)}]\n[mkpc]\n{mkpc_table}\n{TAIL}"


def run(files: Sequence[Path], out: Path, options: Sequence[str]) -> tuple[int, list[Run]]:
    """Run the recipes on the same pairs. Return the exit status and the figures of each run.

    There are no figures if a run is incomplete.
    """
    figures = out / "figures.json"
    figures.unlink(missing_ok=True)
    paths = ["--work-dir", str(out), "--json", str(figures)]
    status = mkpc(["validate", "--compare", *map(str, files), *paths, *options])
    if status:
        return status, []
    return 0, json.loads(figures.read_text(encoding="utf-8"))


def values_of(scene: dict[str, Any]) -> list[float]:
    """Return the value of each pair: its accuracy after the last step, the mAA's summand."""
    return [[*pair["accuracy_by_step"].values()][-1] for pair in scene["pairs"]]


def images_of(pair: dict[str, Any]) -> tuple[str, str]:
    """Return the paths of a pair's images."""
    first, second = pair["images"]
    return first, second


def groups_of(scenes: Sequence[str], chosen: str) -> dict[str, list[int]]:
    """Return the indices of the scenes of each group of the last tables, by the group's name."""
    groups = {"all": list(range(len(scenes)))}
    for scale in sorted(set(re.findall(r"_zoom(\d)", " ".join(scenes)))):
        groups[f"x{scale}"] = [
            i for i in groups["all"] if scenes[i].endswith(f"_zoom{scale}")
        ]
    if chosen:
        groups["chosen on"] = [i for i in groups["all"] if re.match(chosen, scenes[i])]
        groups["confirmed on"] = [i for i in groups["all"] if not re.match(chosen, scenes[i])]
    return groups


def gain_lines(runs: Sequence[Run], layouts: Sequence[str], chosen: str) -> list[str]:
    """Return the tables: the last layout's gain over each other one, by group of scenes."""
    scenes = runs[-1]["scenes"]
    groups = groups_of([scene["scene"] for scene in scenes], chosen)
    lines = []
    for name, other in zip(layouts[:-1], runs[:-1], strict=True):
        lines.append(
            f"\n{layouts[-1]} against {name}: both, and the gain with its 95 % interval"
        )
        pairs: list[Paired] = []
        for before, after in zip(other["scenes"], scenes, strict=True):
            images = [images_of(pair) for pair in after["pairs"]]
            pairs.append((values_of(before), values_of(after), images))
        for group, indices in groups.items():
            chosen_pairs = [pairs[index] for index in indices]
            before_mean = mean(mean(first) for first, _, _ in chosen_pairs)
            after_mean = mean(mean(second) for _, second, _ in chosen_pairs)
            count = sum(len(images) for _, _, images in chosen_pairs)
            means = f"{count:>5}{before_mean:>9.4f}{after_mean:>9.4f}"
            lines.append(f"{group:<14}{means}  {paired_difference(chosen_pairs)}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--matcher", default="aliked_lightglue")
    parser.add_argument("--rootsift", action="store_true", help="its unit of `light` first")
    parser.add_argument("--layouts", nargs="+", choices=list(LAYOUTS), default=list(LAYOUTS))
    parser.add_argument(
        "--chosen", default="", metavar="REGEX", help="start of scenes' names"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("options", nargs="*")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    files = []
    for layout in given.layouts:
        file = given.out / f"{layout}.toml"
        toml = recipe(given.matcher, layout, rootsift=given.rootsift)
        file.write_text(toml, encoding="utf-8")
        files.append(file)
    status, runs = run(files, given.out, given.options)
    if runs:
        print("\n".join(gain_lines(runs, given.layouts, given.chosen)))
    return status


if __name__ == "__main__":
    raise SystemExit(main())
