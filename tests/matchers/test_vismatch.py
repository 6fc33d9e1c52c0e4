"""The example of docs/research.md, a custom matcher, with a stand-in of vismatch's interface."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from pictures import as_picture, match_one, write_two_views
from standin import scene

PAGE = Path(__file__).resolve().parents[2] / "docs" / "research.md"
(EXAMPLE,) = re.findall(
    r"^```python\n(import numpy.*?)^```", PAGE.read_text("utf-8"), re.M | re.S
)
PICTURE = scene(160, 200, 3)
POINTS = np.stack(
    np.meshgrid(np.arange(8.0, 120, 8), np.arange(8.0, 88, 8)), axis=-1
).reshape(-1, 2)


class Standin:
    """``corner``: the offset of its points; ``confidences`` of its matches."""

    def __init__(self, corner: float = 0.0, confidences: np.ndarray | None = None) -> None:
        self.corner = corner
        self.confidences = confidences
        self.skip_ransac = False  # vismatch's default
        self.seen = []

    def __call__(self, *images: torch.Tensor) -> dict:
        assert self.skip_ransac, "a homography would be fitted to the matches"
        self.seen += images
        points = POINTS + self.corner
        return {
            "matched_kpts0": points,
            "matched_kpts1": np.add(points, (3, 2)),
            "matched_confidences": self.confidences,
        }


@pytest.fixture
def names(monkeypatch, tmp_path) -> dict:
    """The names of the example after it ran; ``asked`` has the matchers that it got."""
    write_two_views(tmp_path)
    monkeypatch.chdir(tmp_path)
    found = {"asked": []}

    def get_matcher(name: str, device: str) -> Standin:
        found["asked"].append(Standin())
        return found["asked"][-1]

    library = SimpleNamespace(get_matcher=get_matcher, __version__="1.4")
    monkeypatch.setitem(sys.modules, "vismatch", library)
    exec(compile(EXAMPLE, str(PAGE), "exec"), found)
    return found


def test_the_example_runs_in_both_stages_on_rgb_images_in_0_to_1(names):
    assert len(EXAMPLE.splitlines()) <= 32
    match = names["match"]
    assert [result.failure for result in match.results] == ["", ""]
    assert len(match.matches) == 2 * len(POINTS)
    for image in names["asked"][0].seen:
        assert [side % 16 for side in image.shape[1:]] == [0, 0]
        assert 0.5 < image.max() <= 1


# Its matchers count pixels from a corner or from a centre, and some have no confidences.
@pytest.mark.parametrize(
    ("corner", "confidences"), [(0.0, None), (0.5, np.linspace(0, 1, len(POINTS)))]
)
def test_the_centre_of_the_first_pixel_is_at_0_and_confidences_are_scores(
    names, corner, confidences
):
    matcher = names["Vismatch"]("any", corner=corner)
    names["asked"][-1].corner = corner
    names["asked"][-1].confidences = confidences
    matches = match_one(matcher, as_picture(PICTURE), as_picture(PICTURE))
    assert_allclose(matches.points0, POINTS, atol=1e-4)
    assert_allclose(matches.points1, np.add(POINTS, (3, 2)), atol=1e-4)
    assert_allclose(matches.scores, 1 if confidences is None else confidences)
