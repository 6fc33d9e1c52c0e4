"""Each of the paper's matchers from a checkpoint in the public file's format to submission.csv.

The weights are stand-ins: the matches mean nothing, but all of the real code finds them.
"""

import cv2
import numpy as np
import pytest
from checkpoints import FILES, use_manifest, write_checkpoints
from shared import problem_of, run_command
from standin import narrow_roma, scene

from mkpc_kaggle.data.competition import read_submission
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.matchers.adapters import roma

# The sizes of the units of stages 1 and 2, which fit no network's multiple.
LONG = ("long_side = 209", "long_side = 150")
AREA = ('area = "96x128"', 'area = "70x90"')
# Sizes and options of each matcher.
TRIALS = dict.fromkeys(("superglue", "loftr", "quadtree", "aspanformer"), (LONG, ""))
TRIALS |= dict.fromkeys(("dkm", "roma"), (AREA, ""))
TRIALS["loma"] = LONG, 'variant = "b128"\nmax_keypoints = 300'


@pytest.fixture(scope="module")
def test_dir(tmp_path_factory):
    """A test side of odd sizes, landscape and portrait, a picture without texture, and one of 33 x
    47 pixels.
    """
    directory = tmp_path_factory.mktemp("made")
    whole = scene(240, 240, channels=3)
    pictures = {
        "landscape": whole[64:203, 16:225],
        "portrait": whole[16:225, 40:179],
        "small": whole[120:167, 80:113],
        "blank": np.zeros((131, 175, 3), np.uint8),
    }
    (directory / "test_images" / "made").mkdir(parents=True)
    for name, pixels in pictures.items():
        cv2.imwrite(str(directory / "test_images" / "made" / f"{name}.png"), pixels)
    pairs = [("landscape", "portrait"), ("small", "blank")]
    rows = [f"made;{first}-{second},made,{first},{second}" for first, second in pairs]
    head = "sample_id,batch_id,image_1_id,image_2_id"
    (directory / "test.csv").write_text("\n".join([head, *rows]))
    return directory


# Stand-in networks have low scores, and fewer sampled matches take less time.
FEW = {"loma": "\nthreshold = 0.0", "dkm": "\nmatches = 300", "roma": "\nmatches = 300"}


@pytest.mark.parametrize("matcher", TRIALS)
def test_odd_small_and_blank_pictures_are_matched_without_an_error(
    clean_environment, monkeypatch, matcher, test_dir, tmp_path
):
    checkpoints = write_checkpoints(
        tmp_path, [file for file in FILES if file.matcher == matcher]
    )
    use_manifest(monkeypatch, checkpoints)
    # The published width needs more time and memory than a test should.
    monkeypatch.setattr(roma, "RoMa", narrow_roma)
    sizes, options = TRIALS[matcher]
    options += FEW.get(matcher, "")
    recipe = tmp_path / "r.toml"
    recipe.write_text(f"""
        units = [
            {{ stage = 1, matcher = "{matcher}", {sizes[0]} }},
            {{ stage = 2, matcher = "{matcher}", {sizes[1]} }},
        ]
        [matchers.{matcher}]
        {options}
        [magsac]
        max_iterations = 2000
    """)
    output = tmp_path / "out.csv"
    given = [
        "--test-dir",
        test_dir,
        "--output",
        output,
        "--recipe",
        recipe,
        "--weights",
        tmp_path,
    ]
    assert (
        run_command("submit", "--no-report", *given, "--device", "cpu", "--workers", 0) == 0
    )
    assert problem_of(output, test_dir) == ""
    # Every row is an F of rank 2, the fallback of the blank picture too.
    for F in read_submission(output).values():
        strengths = np.linalg.svd(F, compute_uv=False)
        assert strengths[2] < 1e-6 * strengths[0] < 1e6 * strengths[1]
    tables = results(tmp_path / "out.work")
    number = {pair: index for index, pair in enumerate(tables.pairs["pair"])}
    found = {
        (number[unit.pair], int(unit.unit[0])): unit for unit in tables.units.itertuples()
    }
    assert found.keys() == {(pair, stage) for pair in range(2) for stage in (1, 2)}
    assert {unit.failure for unit in found.values()} == {""}
    assert found[0, 1].matches >= 8
    # Dense matchers have answers for all pixels, and LoMa has keypoints on any picture.
    if matcher not in {"dkm", "roma", "loma"}:
        assert found[1, 1].matches == found[1, 2].matches == 0
