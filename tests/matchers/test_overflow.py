"""Numbers that overflow, as those of half precision may, are an error: never a lack of keypoints or matches."""

import pytest
import torch
from light_matchers import MATCHERS, SHIFT, picture
from torch.nn import functional

from mkpc_kaggle.matchers.contract import NonFiniteError, Placement
from mkpc_kaggle.matchers.dtypes import check_finite


def overflow(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on all linear maps and convolutions do."""
    for name in ("linear", "conv1d", "conv2d"):
        exact = getattr(functional, name)
        monkeypatch.setattr(
            functional, name, lambda *args, exact=exact, **kwargs: exact(*args, **kwargs) * torch.inf
        )


@pytest.mark.parametrize("name", [name for name in MATCHERS if name != "sift_lightglue"])
def test_overflow_in_a_picture_is_an_error(name, monkeypatch):
    matcher = MATCHERS[name](Placement())
    overflow(monkeypatch)
    with pytest.raises(NonFiniteError):
        check_finite("features", list(matcher.encode([picture(matcher.spec.colour, 0)])))


@pytest.mark.parametrize("name", [name for name in MATCHERS if name != "aliked"])
def test_overflow_between_two_pictures_is_an_error(name, monkeypatch):
    """Nearest neighbours need no network."""
    matcher = MATCHERS[name](Placement())
    encodings = [list(matcher.encode([picture(matcher.spec.colour, 0, shift)])) for shift in (SHIFT, 0)]
    overflow(monkeypatch)
    with pytest.raises(NonFiniteError):
        matcher.match(*encodings)
