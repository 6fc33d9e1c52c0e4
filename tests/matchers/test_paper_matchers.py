"""Each of the paper's matchers from a checkpoint in the public file's format to submission.csv.

The weights are stand-ins: the matches mean nothing, but all of the real code finds them.
"""

import cv2
import numpy as np
import pytest
from checkpoints import FILES, use_manifest, write_checkpoints
from shared import problems_of, run_command
from standin import narrow_roma, scene

from mkpc_kaggle.data.competition import read_submission
from mkpc_kaggle.engine.records import read_records
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.matchers.adapters import roma

LONG, AREA = ("long_side = 209", "long_side = 150"), ('area = "96x128"', 'area = "70x90"')
# The sizes of the units of stages 1 and 2, which fit no network's multiple, and the matcher's
# options.
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
    pictures = {"landscape": whole[64:203, 16:225], "portrait": whole[16:225, 40:179]}
    pictures |= {"small": whole[120:167, 80:113], "blank": np.zeros((131, 175, 3), np.uint8)}
    (directory / "test_images" / "made").mkdir(parents=True)
    for name, pixels in pictures.items():
        cv2.imwrite(str(directory / "test_images" / "made" / f"{name}.png"), pixels)
    pairs = [("landscape", "portrait"), ("small", "landscape"), ("portrait", "blank")]
    rows = [f"made;{first}-{second},made,{first},{second}" for first, second in pairs]
    (directory / "test.csv").write_text(
        "\n".join(["sample_id,batch_id,image_1_id,image_2_id", *rows])
    )
    return directory


# Stand-in networks have low scores, and fewer sampled matches take less time.
FEW = {"loma": "\nthreshold = 0.0", "dkm": "\nmatches = 300", "roma": "\nmatches = 300"}


@pytest.mark.parametrize("matcher", TRIALS)
def test_odd_small_and_blank_pictures_go_through(
    clean_environment, monkeypatch, matcher, test_dir, tmp_path
):
    checkpoints = write_checkpoints(tmp_path, [file for file in FILES if file.matcher == matcher])
    use_manifest(monkeypatch, checkpoints)
    monkeypatch.setattr(roma, "RoMa", narrow_roma)
    sizes, options = TRIALS[matcher]
    options += FEW.get(matcher, "")
    units = [
        f'{{ stage = {n}, matcher = "{matcher}", {size} }}' for n, size in enumerate(sizes, start=1)
    ]
    magsac = "[magsac]\npermutations = 1\nmax_iterations = 2000"
    (tmp_path / "r.toml").write_text(
        f"units = [{', '.join(units)}]\n[matchers.{matcher}]\n{options}\n{magsac}"
    )
    output, given = tmp_path / "out.csv", ("--recipe", tmp_path / "r.toml", "--weights", tmp_path)
    options = (
        "--test-dir",
        test_dir,
        "--output",
        output,
        *given,
        "--device",
        "cpu",
        "--workers",
        0,
    )
    assert run_command("submit", "--no-report", *options) == 0
    assert problems_of(output, test_dir) == []
    for F in read_submission(output).values():
        strengths = np.linalg.svd(F, compute_uv=False)
        assert strengths[2] < 1e-6 * strengths[0] < 1e6 * strengths[1]
    with Store.read(tmp_path / "out.work") as store:
        found = {
            (record.index, unit.stage): unit
            for record in read_records(store)
            for unit in record.units
        }
    assert found.keys() == {(pair, stage) for pair in range(3) for stage in (1, 2)}
    assert {unit.failure for unit in found.values()} == {""}
    assert found[0, 1].matches >= 8
    # Which have answers for all pixels, and keypoints on any picture
    if matcher not in {"dkm", "roma", "loma"}:
        assert found[2, 1].matches == found[2, 2].matches == 0
