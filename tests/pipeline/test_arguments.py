"""Arguments of the Python API: every accepted and every refused type, and errors that are seen."""

import pickle
import warnings
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch
from exif_files import set_exif
from light_matchers import standin
from pictures import same
from shared import run_command, write_recipe
from sklearn.datasets import load_sample_image

from mkpc_kaggle import PairMatch, TwoStageMatcher
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.matchers.contract import MatcherSpec
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.pipeline.arguments import as_image, intrinsics_of
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.setup import assembly

pytestmark = pytest.mark.usefixtures("nowhere_else")

SIFT = Recipe((Unit(1, "sift", 320),))
TWO_STAGES = Recipe((Unit(1, "sift", 320), Unit(2, "sift", 320)))
K = np.array([[300.0, 0, 140], [0, 300, 100], [0, 0, 1]])
ROTATED = 6  # EXIF's orientation of a camera on its side


@cache
def pixels(shift: int = 0):
    photograph = load_sample_image("china.jpg")[100:300, 100 + shift : 380 + shift]
    return np.ascontiguousarray(photograph)


def chw(image):
    return torch.from_numpy(image.copy()).permute(2, 0, 1)


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def raises(call, error, *words):
    """Raise unless the call raises ``error`` with all words in one line."""
    with pytest.raises(error) as raised:
        call()
    message = str(raised.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message


# Images


SAME = {  # forms of one image
    "uint8": lambda image: image,
    "a subclass of an array": np.ma.array,
    "float64 in 0..1": lambda image: image / 255,
    "PIL, with alpha": lambda image: PIL.Image.fromarray(image).convert("RGBA"),
    "tensor (3, H, W)": chw,
    "tensor with a gradient": lambda image: (chw(image) / 255).requires_grad_(),
}
SAME_GRAY = {
    "(H, W)": gray,
    "PIL, 16 bits": lambda image: PIL.Image.fromarray(gray(image).astype(np.uint16) * 256),
    "tensor (1, H, W)": lambda image: torch.from_numpy(gray(image))[None],
}


@pytest.mark.parametrize("form", [*SAME, *SAME_GRAY])
def test_an_image_in_each_form_has_the_same_pixels(form):
    found = as_image((SAME | SAME_GRAY)[form](pixels()))
    expected = pixels() if form in SAME else np.stack([gray(pixels())] * 3, axis=2)
    np.testing.assert_array_equal(found.pixels, expected)


def test_a_pil_image_has_the_orientation_of_its_file(tmp_path):
    path = tmp_path / "a.png"
    PIL.Image.fromarray(pixels()).save(path)
    set_exif(path, ROTATED)
    for source in (path, str(path), PIL.Image.open(path)):
        assert as_image(source).turns == 3
        np.testing.assert_array_equal(as_image(source).pixels, pixels())


REFUSED_IMAGES = {
    "None": (None, ValueError, "object"),
    "floats to 255": (pixels().astype(float), ValueError, "0..1"),
    "NaN": (np.full((9, 9), np.nan), ValueError, "0..1"),
    "four channels": (np.zeros((9, 9, 4), np.uint8), ValueError, "(9, 9, 4)"),
    "batch of tensors": (
        torch.zeros(2, 3, 9, 9, dtype=torch.uint8),
        ValueError,
        "(2, 3, 9, 9)",
    ),
    "PIL, floats": (PIL.Image.new("F", (9, 9)), ValueError, "more than 16 bits"),
    "no such file": ("none.png", UserError, "none.png: no such file"),
    "a folder": (".", UserError, "not a regular file"),
}


class Unrun:
    """A matcher that must not run."""

    spec = MatcherSpec("unrun")

    def encode(self, pictures):
        raise AssertionError("arguments are checked before any work")

    match = encode


def unrun(*units):
    return TwoStageMatcher(
        Recipe(units or (Unit(1, "unrun", 320),)), matchers={"unrun": Unrun()}
    )


@pytest.mark.parametrize("form", REFUSED_IMAGES)
def test_another_value_for_an_image_is_refused_before_any_matching(form):
    value, error, word = REFUSED_IMAGES[form]
    raises(lambda: unrun()(pixels(), value), error, word)


# Camera matrices


@pytest.mark.parametrize(
    "given",
    [
        (K, K),
        np.stack([K, K]),
        [[list(map(int, row)) for row in K]] * 2,
        (torch.from_numpy(K), torch.from_numpy(K).float().requires_grad_()),
    ],
)
def test_camera_matrices_in_each_form_are_the_same(given):
    first, second = intrinsics_of(given)
    np.testing.assert_array_equal(first, K)
    np.testing.assert_array_equal(second, K)
    assert first.dtype == second.dtype == np.float64


@pytest.mark.parametrize(
    "given", [K, (K, None), 300.0, (K * 0, K), (K, K.T), (K, K * np.nan)]
)
def test_other_camera_matrices_are_refused_before_any_matching(given):
    with pytest.raises((TypeError, ValueError)):
        unrun()(pixels(), pixels(), intrinsics=given)


# Other arguments


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"recipe": None}, TypeError, ["PathLike", "None"]),
        ({"recipe": "sfit"}, UserError, ["'sfit'", "classical", "aliked_lightglue"]),
        ({"recipe": Path("none.toml")}, UserError, ["none.toml cannot be read"]),
        ({"weights": 5}, TypeError, ["int", "iterable"]),
        ({"weights": "none"}, UserError, ["weights none: no such directory"]),
        (
            {"weights": {"aliked": "a.pth"}},
            UserError,
            ["unknown slot 'aliked'", "aliked-n16"],
        ),
        (
            {"weights": {"aliked-n16": "none.pth"}},
            UserError,
            ["aliked-n16", "none.pth", "No such"],
        ),
        ({"device": "gpu"}, UserError, ["'gpu'"]),
        ({"precision": "half"}, ValueError, ["'half'", "Precision"]),
        ({"settings": [1]}, TypeError, ["sequence"]),
        ({"settings": {"magsac.threshold": "wide"}}, UserError, ["threshold", "'wide'"]),
        ({"settings": {"magsac.threshold": np.ones(2)}}, UserError, ["threshold", "array"]),
        ({"matchers": {"sift": SiftMatcher}}, TypeError, ["'sift' is <class", "instance"]),
    ],
)
def test_another_argument_of_a_matcher_is_refused_by_name(arguments, error, words):
    given = {"recipe": "classical"} | arguments
    raises(lambda: TwoStageMatcher(given.pop("recipe"), **given), error, *words)


def write_aliked(path, extra=()):
    network = standin("aliked", Aliked, 200)
    table = {f"module.{name}": tensor for name, tensor in network.state_dict().items()}
    torch.save({"model": table | dict(extra), "epoch": 3}, path)
    return path


@pytest.mark.filterwarnings("ignore:no F was found")
def test_own_weights_are_a_file_for_a_slot(tmp_path):
    path = write_aliked(tmp_path / "mine.pth")
    given = {"aliked-n16": path}
    made_settings = {"matchers.aliked.features": 200}
    made = TwoStageMatcher("aliked", weights=given, settings=made_settings)
    assert made.recipe.matcher_names == ("aliked",)
    match = made(pixels(), pixels(40))
    assert match.failures == {}
    assert len(match.matches) > 0

    write_aliked(path, {"module.head": torch.zeros(1)})
    with (
        pytest.warns(RuntimeWarning, match=r'Unexpected key.* "head".*mine\.pth'),
        pytest.warns(RuntimeWarning, match="no F was found"),
    ):
        match = TwoStageMatcher("aliked", weights=given)(pixels(), pixels(40))
    assert not match.estimate


def test_the_name_of_a_matcher_is_a_recipe(tmp_path):
    made = TwoStageMatcher("sift")
    (unit,) = made.recipe.units
    auto = load_recipe("auto")
    assert unit == next(unit for unit in auto.units if unit.matcher == "sift")
    assert (made.recipe.name, made.recipe.magsac, made.recipe.focal) == (
        "sift",
        auto.magsac,
        auto.focal,
    )
    (unit,) = TwoStageMatcher("own", matchers={"own": Own(fail)}).recipe.units
    assert unit == Unit(1, "own", 1024)
    assert TwoStageMatcher("classical:stage-1").recipe.name == "classical (stage-1)"


def test_a_model_of_another_name_is_refused():
    raises(lambda: unrun()(pixels(), pixels(), model="G"), ValueError, "'G' is not a valid")
    raises(
        lambda: unrun()(pixels(), pixels(), model="E"), ValueError, "model E needs intrinsics"
    )


def test_arguments_of_pairs_are_those_of_a_call():
    matcher = TwoStageMatcher(TWO_STAGES)
    pair = (pixels(), pixels(40))
    options = {"intrinsics": (K, K)}
    expected = matcher(*pair, model="E", **options)
    given = {name: [value, None] for name, value in options.items()}
    given["intrinsics"][1] = (K, K)
    found, _ = matcher.match_pairs([pair, pair], model="E", **given)
    assert same(found.matches, expected.matches)
    np.testing.assert_array_equal(found.estimate.matrix, expected.estimate.matrix)
    assert found.estimate.model == "E"
    short = matcher.match_pairs([pair, pair], intrinsics=[(K, K)])
    raises(lambda: list(short), ValueError, "shorter")


# Errors


class Own:
    """A matcher of the user's, whose ``match`` is given."""

    spec = MatcherSpec("own", colour="gray")

    def __init__(self, match):
        self.match = match

    def encode(self, pictures):
        return [None for _ in pictures]


def fail(*_):
    raise RuntimeError("my bug")


def own(match):
    return TwoStageMatcher(Recipe((Unit(1, "own", 320),)), matchers={"own": Own(match)})


def test_an_error_of_the_users_own_matcher_is_raised():
    for call in (
        lambda: own(fail)(pixels(), pixels()),
        lambda: list(own(fail).match_pairs([(pixels(), pixels())])),
    ):
        with pytest.raises(RuntimeError, match="my bug") as raised:
            call()
        assert raised.value.__notes__ == ["in 1:own@320"]


ONE = Matches([(1, 1)], [(2, 2)], [1])


@pytest.mark.parametrize(
    ("answer", "word"),
    [
        (None, "not None"),
        (ONE, "not Matches"),
        ([ONE, ONE], "not [Matches"),
    ],
)
def test_another_answer_of_the_users_own_matcher_is_named(answer, word):
    call = own(lambda *_: answer)
    raises(
        lambda: call(pixels(), pixels()),
        TypeError,
        "match of 'own'",
        "a list of Matches",
        word,
    )


class Unlucky(SiftMatcher):
    def match(self, encodings0, encodings1):
        raise RuntimeError("out of luck")


@pytest.fixture
def unlucky(monkeypatch):
    """The package's own RootSIFT fails."""
    monkeypatch.setattr(
        assembly, "load_matcher", lambda *_: Unlucky(SiftOptions(features=100), "cpu")
    )


def test_a_unit_that_fails_is_a_warning_and_an_estimate_without_points_names_it(unlucky):
    with (
        pytest.warns(
            RuntimeWarning, match=r"unit 1:sift@320 failed: RuntimeError: out of luck"
        ),
        pytest.warns(RuntimeWarning, match="no F was found: too few"),
    ):
        match = TwoStageMatcher(SIFT)(pixels(), pixels(40))
    assert match.failures == {"1:sift@320": "RuntimeError: out of luck"}
    assert not match.estimate
    assert match.estimate.inlier_count == 0
    assert np.isfinite(match.estimate.matrix).all()


@pytest.mark.usefixtures("unlucky")
def test_the_command_match_ends_with_1_if_every_unit_failed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    PIL.Image.fromarray(pixels()).save("a.png")
    write_recipe(Path("one.toml"), (1, 320))
    with warnings.catch_warnings():  # a command prints them
        warnings.simplefilter("always")
        assert run_command("match", "a.png", "a.png", "--recipe", "one.toml") == 1
    printed = capsys.readouterr()
    assert "out of luck" in printed.err
    assert "out of luck" in printed.out


# What a result keeps


def test_a_result_keeps_no_image_and_can_be_pickled():
    matcher = TwoStageMatcher(TWO_STAGES)
    for match in (
        matcher(pixels(), pixels(40)),
        *matcher.match_pairs([(pixels(), pixels(40))]),
    ):
        assert match.images == ()
        assert match.sizes == ((280, 200), (280, 200))
        data = pickle.dumps(match)
        assert len(data) < pixels().nbytes / 2
        copy: PairMatch = pickle.loads(data)
        assert same(copy.matches, match.matches)
        np.testing.assert_array_equal(copy.estimate.matrix, match.estimate.matrix)
