"""The options --intrinsics and --masks of ``reconstruct``: what is refused, changed and computed
again.
"""

import csv
import unicodedata
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exif_files import set_exif
from rectified import Seen
from shared import run_command
from test_reconstruct import FIRST, RECIPE, MixedMatcher, cameras, contents, write_flat

from benchmarks.synthetic_scene import SIZE
from mkpc_kaggle import results
from mkpc_kaggle.data.masks import MaskReader, Masks
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.intrinsics import KnownCamera, Rows
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.reconstruction.folder import read_folder
from mkpc_kaggle.reconstruction.outputs import camera_rows
from mkpc_kaggle.reconstruction.priors import (
    crops_line,
    intrinsics_line,
    read_intrinsics_table,
)
from mkpc_kaggle.reconstruction.python import reconstruct
from mkpc_kaggle.reconstruction.run import FolderResult, for_cameras, reconstruct_folder
from mkpc_kaggle.scene.models import SfmModel
from mkpc_kaggle.setup.assembly import assemble

HEAD = "image,model,parameters\n"
SIZED = "image,model,parameters,size\n"


def run(
    root: Path,
    out: Path,
    matcher: MixedMatcher | None = None,
    *,
    known: Rows = (),
    masks: Masks | None = None,
    interrupt: Interrupt | None = None,
    budget: Budget | None = None,
) -> FolderResult:
    session = Session(
        out / "work",
        budget or Budget(0.0, float("inf")),
        interrupt or Interrupt(),
        progress=False,
        workers=0,
    )
    assembly = assemble(RECIPE, matchers={"synthetic": matcher or MixedMatcher()}, device="cpu")
    recipe = for_cameras(assembly.recipe)
    assembly = replace(assembly, recipe=recipe, masks=masks or Masks(), cameras=known)
    return reconstruct_folder(root, read_folder(root), assembly, session, out)


def write_masks(folder: Path, root: Path, left: int = 400) -> Path:
    """Write masks that leave the columns from ``left`` on."""
    folder.mkdir(exist_ok=True)
    mask = np.zeros((SIZE.height, SIZE.width), np.uint8)
    # 1 is nearly black, but not black.
    mask[:, left:] = 1
    for image in root.iterdir():
        cv2.imwrite(str(folder / f"{image.name}.png"), mask)
    return folder


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ("", "is empty; expected the columns"),
        (HEAD, "has no rows"),
        (HEAD + "00.png,PINHOLE,1 2 3\n", "line 2: PINHOLE has 4 parameters"),
        (HEAD + "00.png,PINHOLE\n", "line 2: 2 cells"),
        (
            HEAD + "none*.png,SIMPLE_PINHOLE,900 400 300\n",
            "line 2: row 'none*.png' matches no image",
        ),
        (
            HEAD + "*,SIMPLE_PINHOLE,900 400 300,2\n00.png,SIMPLE_PINHOLE,900 400 300,2\n",
            "line 3: row '00.png' matches no image",
        ),
        (
            HEAD + "00.png,SIMPLE_PINHOLE,9 400 300\n",
            "line 2: a focal length of 9 px is implausible for 00.png",
        ),
        # Focal lengths and middles in turn, and coefficients of another convention
        (HEAD + "*,PINHOLE,900 400 900 300\n", "the principal point 900, 300 is outside"),
        (
            HEAD + "*,OPENCV,900 900 400 300 -8 0 0 0\n",
            "with this distortion no pixel of 00.png is more than 122 px from the middle",
        ),
        (
            HEAD + "00.png,SIMPLE_PINHOLE,900 4000 300\n",
            "line 2: the principal point 4000, 300 is outside",
        ),
        # A calibration at another resolution, of the rotated picture, and with its size
        (
            HEAD + "*,PINHOLE,450 451 200 150\n",
            "the row seems to be for 400 x 300. Write the parameters 900 902 400 300",
        ),
        (
            HEAD + "*,SIMPLE_RADIAL,1800 800 600 -0.1,2\n",
            "the row seems to be for 1600 x 1200. Write the parameters 900 400 300 -0.1",
        ),
        (
            HEAD + "*,SIMPLE_PINHOLE,675 300 225,5\n",
            "is far from the middle: 00.png has 800 x 600 pixels, and the row seems to be for 600 x 450",
        ),
        # A principal point is a little off the middle, and the ratio of resolutions is simple.
        (
            HEAD + "*,PINHOLE,450 450 197 153\n",
            "the row seems to be for 400 x 300. Write the parameters 900 900 394 306;",
        ),
        # Neither the focal length nor the principal point fits: the reason for both
        (
            HEAD + "*,SIMPLE_PINHOLE,90 40 30\n",
            "the row seems to be for 80 x 60. Write the parameters 900 400 300;",
        ),
        (
            HEAD + "*,SIMPLE_PINHOLE,900 306 394\n",
            "the row seems to be for 600 x 800. Rows are for pixels as stored",
        ),
        (
            HEAD + "*,SIMPLE_PINHOLE,900 200 300,5\n",
            "if the row is right, add the column size with",
        ),
        (
            SIZED + "*,SIMPLE_PINHOLE,450 200 150,400x300\n",
            "the row is for 400 x 300, and 00.png has 800 x 600 pixels. Write the parameters 900 400",
        ),
        (SIZED + "*,SIMPLE_PINHOLE,900 300 400,600 x 800\n", "Rows are for pixels as stored"),
        (SIZED + "*,SIMPLE_PINHOLE,900 400 300,800\n", "a size is width x height such as"),
        ("\xff\x00", "line contains NUL"),
        (None, "no such file"),
    ],
)
def test_a_bad_table_of_intrinsics_is_one_line_and_nothing_is_touched(
    tmp_path, capsys, table, reason
):
    root = write_flat(tmp_path / "images", 3)
    out = tmp_path / "out"
    file = tmp_path / "known.csv"
    if table is not None:
        file.write_text(table)
    before = contents(tmp_path)
    assert run_command("reconstruct", root, "--out", out, "--intrinsics", file) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line
    assert contents(tmp_path) == before
    assert not out.exists()


# Rows for images of 800 x 600 pixels, and the warnings about them
ACCEPTED = {
    "centred": (HEAD + "*,SIMPLE_PINHOLE,900 410 290\n", []),
    "somewhat off": (HEAD + "*,SIMPLE_PINHOLE,900 460 300\n", ["far from the middle"]),
    "off, with the size": (SIZED + "*,SIMPLE_PINHOLE,900 100 100,800x600\n", []),
    "without the size": (SIZED + "*,SIMPLE_PINHOLE,900 400 300,\n", []),
}


@pytest.mark.parametrize(("table", "warnings"), ACCEPTED.values(), ids=ACCEPTED)
def test_a_principal_point_off_the_middle_is_warned_of_once_unless_the_size_is_stated(
    tmp_path, capsys, table, warnings
):
    root = write_flat(tmp_path / "images", 3)
    file = tmp_path / "known.csv"
    file.write_text(table)
    assert len(read_intrinsics_table(file, root, sorted(root.iterdir()))) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(warnings)
    assert all(text in line for text, line in zip(warnings, lines, strict=True))


BAD_MASKS = {
    "no such directory": lambda folder, root: None,
    "has no mask of any image: 00.png.png would be the first": lambda folder, root: folder.mkdir(),
    "it is no picture": lambda folder, root: (write_masks(folder, root) / "01.png.png").write_bytes(
        b"no"
    ),
    "not a regular file": lambda folder, root: (
        (write_masks(folder, root) / "01.png.png").unlink(),
        (folder / "01.png.png").mkdir(),
    ),
    "has 9 x 9 pixels, its image 800 x 600": lambda folder, root: cv2.imwrite(
        str(write_masks(folder, root) / "02.png.png"), np.ones((9, 9))
    ),
    "its image 800 x 600; masks are for pixels as stored, without the rotation of EXIF": (
        lambda folder, root: cv2.imwrite(
            str(write_masks(folder, root) / "02.png.png"), np.ones((SIZE.width, SIZE.height))
        )
    ),
}


@pytest.mark.parametrize("reason", BAD_MASKS)
def test_bad_masks_are_one_line_and_nothing_is_touched(tmp_path, capsys, reason):
    root = write_flat(tmp_path / "images", 3)
    out = tmp_path / "out"
    BAD_MASKS[reason](tmp_path / "masks", root)
    assert run_command("reconstruct", root, "--out", out, "--masks", tmp_path / "masks") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line
    assert not out.exists()


def test_focal_lengths_that_differ_are_warned_of(tmp_path, capsys):
    root = write_flat(tmp_path / "images", 3)
    table = tmp_path / "known.csv"
    for row, is_warned in (("900 300 400 300", True), ("900 905 400 300", False)):
        table.write_text(f"{HEAD}*,PINHOLE,{row}\n")
        read_intrinsics_table(table, root, sorted(root.iterdir()))
        text = capsys.readouterr().err
        assert ("fx and fy differ by 200 %, and pixels of cameras are square" in text) == is_warned


def test_the_images_without_a_known_camera_are_counted(tmp_path):
    root = write_flat(tmp_path / "images", 3)
    # As cameras name them: a pattern is of one case.
    (root / "01.png").rename(root / "01.PNG")
    table = tmp_path / "known.csv"
    table.write_text(f"{HEAD}*.png,SIMPLE_PINHOLE,900 400 300\n")
    files = sorted(root.iterdir())
    known = read_intrinsics_table(table, root, files)
    line = "known cameras: 2 of 3 images; the first without one is 01.PNG"
    assert intrinsics_line(known, root, files) == line
    assert intrinsics_line(known, root, files[::2]) == "known cameras: 2 of 2 images"


def test_a_row_names_a_photograph_of_macos_too(tmp_path):
    root = write_flat(tmp_path / "images", 3)
    name = "\N{LATIN SMALL LETTER E WITH ACUTE}.png"
    (root / "00.png").rename(root / unicodedata.normalize("NFD", name))
    table = tmp_path / "known.csv"
    row = unicodedata.normalize("NFC", name)
    table.write_text(f"{HEAD}{row},SIMPLE_PINHOLE,900 400 300\n", encoding="utf-8")
    files = sorted(root.iterdir())
    known = read_intrinsics_table(table, root, files)
    assert intrinsics_line(known, root, files).startswith("known cameras: 1 of 3 images")


def test_masks_among_the_images_are_refused(tmp_path):
    root = write_flat(tmp_path / "images", 3)
    # As a user may well put them
    folder = write_masks(root / "masks", root)
    found = [file for files in read_folder(root).values() for file in files]
    with pytest.raises(UserError, match="masks count as images"):
        Masks.of_folder(folder, root, found)
    # A hidden folder is no dataset, so its masks are no images.
    hidden = folder.rename(root / ".masks")
    found = [file for files in read_folder(root).values() for file in files]
    assert len(Masks.of_folder(hidden, root, found).files) == 3


def test_black_pixels_of_a_mask_are_left_out(tmp_path):
    root = write_flat(tmp_path / "images", 2)
    masks = Masks.of_folder(write_masks(tmp_path / "masks", root), root, root.iterdir())
    image = str(root / "00.png")
    # Pixels have their centres at integers: 399.4 is in column 399, and 399.6 in column 400.
    points = np.array([[399.4, 10], [399.6, 10], [799.4, 599.4], [0, 0]], np.float32)
    assert MaskReader(masks).shows(image, points, SIZE).tolist() == [False, True, True, False]
    assert MaskReader(masks).shows("another", points, SIZE).all()


def test_masked_matches_are_dropped_before_the_best_are_chosen(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    out = tmp_path / "out"
    masks = Masks.of_folder(write_masks(tmp_path / "masks", root, 300), root, root.iterdir())
    free = run(root, tmp_path / "free")
    result = run(root, out, masks=masks)
    # Masks drop matches before the best are counted, so others may follow.
    masked = result.report.tables.pairs["matches"]
    assert (masked > 0).all()
    assert (masked < free.report.tables.pairs["matches"]).all()
    assert len(cameras(result)) == FIRST


def test_another_mask_is_matched_again_and_other_intrinsics_are_not(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    out = tmp_path / "out"
    run(root, out)
    before = contents(out)
    table = tmp_path / "known.csv"
    truth = MixedMatcher().scenes[0].cameras["0000"].K
    table.write_text(f"{HEAD}00.png,SIMPLE_PINHOLE,{truth[0, 0]} 400 300\n")
    known = read_intrinsics_table(table, root, sorted(root.iterdir()))
    matcher = MixedMatcher()
    result = run(root, out, matcher, known=known)
    # The points do not depend on cameras.
    assert matcher.calls == [], "intrinsics change scenes alone"
    assert cameras(result)["00.png"].camera.K[0, 0] == pytest.approx(truth[0, 0], abs=1e-9)
    assert contents(out) != before
    folder = write_masks(tmp_path / "masks", root, 200)
    expected = FIRST * (FIRST - 1) // 2
    for _ in range(2):
        masks = Masks.of_folder(folder, root, root.iterdir())
        for calls in (expected, 0):
            matcher = MixedMatcher()
            run(root, out, matcher, known=known, masks=masks)
            assert len(matcher.calls) == calls
        # Another mask under the same name
        write_masks(folder, root, 250)
    # A mask without black pixels, of one image
    cv2.imwrite(str(folder / "00.png.png"), np.ones((SIZE.height, SIZE.width), np.uint8))
    matcher = MixedMatcher()
    run(root, out, matcher, known=known, masks=Masks.of_folder(folder, root, root.iterdir()))
    assert len(matcher.calls) == FIRST - 1, "the pairs of the image whose mask changed"
    run(root, out)
    assert contents(out) == before, "without the options, the first results again"


@dataclass
class StoppingMatcher(MixedMatcher):
    """Ends the run, by Ctrl-C or by its time limit, while it matches a pair."""

    last: int = 0  # the number of that pair
    interrupt: Interrupt = field(default_factory=Interrupt)
    seconds: float = 0.0
    is_late: bool = False

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        found = super()._match(seen0, seen1)
        if len(self.calls) == self.last:
            if self.is_late:
                self.seconds = 1000.0
            else:
                self.interrupt.set()
        return found


@pytest.mark.parametrize("is_late", [False, True])
def test_a_run_with_priors_that_was_ended_early_continues_to_the_same_bytes(tmp_path, is_late):
    root = write_flat(tmp_path / "images", FIRST)
    out = tmp_path / "out"
    table = tmp_path / "known.csv"
    table.write_text(f"{HEAD}00.png,SIMPLE_PINHOLE,901 400 300\n*,SIMPLE_PINHOLE,900 400 300\n")
    known = read_intrinsics_table(table, root, sorted(root.iterdir()))
    folder = write_masks(tmp_path / "masks", root, 200)
    masks = Masks.of_folder(folder, root, root.iterdir())
    whole = MixedMatcher()
    run(root, tmp_path / "whole", whole, known=known, masks=masks)
    # The calls of all runs that were ended
    calls = 0
    for last in (1, 4, 7):
        matcher = StoppingMatcher(last=last, is_late=is_late)
        # The clock jumps when the matcher says so.
        budget = Budget(0.0, 500.0, clock=lambda matcher=matcher: matcher.seconds)
        result = run(
            root,
            out,
            matcher,
            known=known,
            masks=masks,
            interrupt=matcher.interrupt,
            budget=budget if is_late else None,
        )
        assert result.report.ending == (Ending.TIME_IS_UP if is_late else Ending.INTERRUPTED)
        calls += len(matcher.calls)
    matcher = MixedMatcher()
    run(root, out, matcher, known=known, masks=masks)
    assert contents(out) == contents(tmp_path / "whole")
    # A pair that was under way when the run ended is matched again, and no other.
    assert calls + len(matcher.calls) <= len(whole.calls) + 3


IN_OUT = {
    "--intrinsics": lambda out: out / "cameras.csv",
    "--masks": lambda out: out / "images",
}


@pytest.mark.parametrize("option", IN_OUT)
def test_priors_in_the_directory_of_results_are_refused_and_stay(tmp_path, capsys, option):
    root = write_flat(tmp_path / "images", 3)
    out = tmp_path / "out"
    # Both are names of results.
    given = IN_OUT[option](out)
    out.mkdir()
    if option == "--masks":
        write_masks(given, root)
    else:
        given.write_text(f"{HEAD}*,SIMPLE_PINHOLE,900 400 300\n")
    before = contents(tmp_path)
    assert run_command("reconstruct", root, "--out", out, option, given) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "contains, or lies in, the input" in line
    assert contents(tmp_path) == before


def test_the_table_is_read_in_the_order_of_its_rows(tmp_path):
    root = write_flat(tmp_path / "in" / "set", 3).parent
    file = tmp_path / "known.csv"
    with file.open("w", newline="") as stream:
        # The first row that fits counts, so the pattern comes last.
        rows = [
            ("set/00.png", "OPENCV", "900 901 400 300 .1 0 0 0"),
            ("*", "SIMPLE_PINHOLE", "850 400 300"),
        ]
        csv.writer(stream).writerows([HEAD.strip().split(","), *rows])
    known = read_intrinsics_table(file, root, sorted(root.rglob("*.png")))
    assert known[0] == ("set/00.png", KnownCamera("OPENCV", (900, 901, 400, 300, 0.1, 0, 0, 0)))
    assert known[1] == ("*", KnownCamera("SIMPLE_PINHOLE", (850, 400, 300)))


def test_a_row_with_a_path_is_the_camera_of_that_image_alone(tmp_path):
    root = tmp_path / "images"
    for name in ("a", "b"):
        write_flat(root / name, FIRST)
    # Other contents: files with the same content share a camera.
    for number, image in enumerate(sorted((root / "b").iterdir())):
        cv2.imwrite(str(image), cv2.imread(str(image)), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        assert image.read_bytes() != (root / "a" / image.name).read_bytes(), number
    table = tmp_path / "known.csv"
    table.write_text(f"{HEAD}a/00.png,SIMPLE_PINHOLE,901 400 300\n")
    known = read_intrinsics_table(table, root, sorted(root.rglob("*.png")))
    result = run(root, tmp_path / "out", known=known)
    focals = {
        name: next(placed.camera.K[0, 0] for file, placed in found.items() if file.name == "00.png")
        for name, found in result.cameras.items()
    }
    assert focals["a"] == pytest.approx(901, abs=1e-9)
    assert abs(focals["b"] - 901) > 1


def test_all_parameters_of_a_distorted_camera_are_in_the_tables(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    table = tmp_path / "known.csv"
    truth = MixedMatcher().scenes[0].cameras["0000"].K[0, 0]
    given = [truth, truth, 400, 300, 0.001, -0.002, 0.0003, -0.0004]
    parameters = " ".join(f"{each:.12g}" for each in given)
    table.write_text(f"{HEAD}00.png,OPENCV,{parameters}\n")
    known = read_intrinsics_table(table, root, sorted(root.iterdir()))
    result = run(root, tmp_path / "out", known=known)
    head, *rows = camera_rows(result.cameras, root)
    cells = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    assert len(cells) == FIRST
    assert cells["00.png"]["camera_model"] == "OPENCV"
    assert cells["00.png"]["parameters"] == parameters
    # The other cameras are pinholes, with COLMAP's principal point.
    assert cells["01.png"]["camera_model"] == "SIMPLE_PINHOLE"
    focal, cx, cy = map(float, cells["01.png"]["parameters"].split())
    K = np.array(cells["01.png"]["K"].split(";"), float)
    assert [focal, cx - 0.5, cy - 0.5] == pytest.approx([K[0], K[2], K[5]])
    # The journal has the same, and so have tables of pandas.
    frame = results(tmp_path / "out" / "work").cameras.set_index("image")
    assert frame.loc["00.png", "camera_model"] == "OPENCV"
    assert frame.loc["00.png", "parameters"] == pytest.approx(given)


def test_python_takes_masks_and_intrinsics_as_the_command_does(tmp_path):
    root = tmp_path / "images"
    files = sorted(write_flat(root / "set", FIRST).iterdir())
    table = tmp_path / "known.csv"
    table.write_text(f"{HEAD}00.png,SIMPLE_PINHOLE,901 400 300\n")

    def models(**priors: object) -> tuple[SfmModel, ...]:
        given = {"synthetic": MixedMatcher()}
        return reconstruct(files, RECIPE, device="cpu", matchers=given, **priors)

    # Without priors, to compare with
    (free,) = models()
    # Names are relative to the images' own folder, as no other is known.
    masks = write_masks(tmp_path / "masks", root / "set", 300)
    (found,) = models(masks=masks, intrinsics=table)
    focals = {Path(each.image.name).name: each.focal for each in found.images}
    assert focals["00.png"] == pytest.approx(901, abs=1e-9)
    assert {each.image.name for each in found.images} == set(map(str, files)), "names are paths"
    # Half the pixels are masked, so there are fewer points.
    assert 0 < len(found.points) < 0.9 * len(free.points)
    for name, reason in (
        ("masks", "has no mask"),
        ("intrinsics", "is empty; expected the columns image"),
    ):
        (tmp_path / "empty").mkdir(exist_ok=True)
        (tmp_path / "empty.csv").touch()
        bad = tmp_path / ("empty" if name == "masks" else "empty.csv")
        with pytest.raises(UserError, match=reason):
            models(**{name: bad})


def write_jpeg(path: Path, width: int, height: int, **tags: int) -> Path:
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.full((height, width, 3), 90, np.uint8))
    return set_exif(path, **tags)


def test_crops_are_counted_by_their_exif_unless_their_camera_is_given(tmp_path, capsys):
    recorded = {"tA002": 640, "tA003": 427}
    root = tmp_path / "photos"
    files = [
        write_jpeg(root / "a.jpg", 520, 427, **recorded),
        write_jpeg(root / "b.jpg", 640, 427, **recorded),
        write_jpeg(root / "c.jpg", 320, 214, **recorded),  # reduced
        write_jpeg(root / "d.jpg", 427, 640, **recorded),  # turned
        write_jpeg(root / "e.jpg", 300, 300, tA405=28),
    ]
    words = "1 of 5 photographs are crops by their EXIF, the first is a.jpg with 520 x 427 pixels"
    assert crops_line((), root, files).startswith(words)
    known = [("a.jpg", KnownCamera("SIMPLE_PINHOLE", (575.0, 200, 213)))]
    assert crops_line(known, root, files) == ""
    recipe = tmp_path / "one.toml"
    recipe.write_text('units = [{ stage = 1, matcher = "sift", long_side = 64 }]\n[scene]\n')
    options = ["--out", tmp_path / "out", "--recipe", recipe, "--workers", 0]
    run_command("reconstruct", root, *options)
    assert words in capsys.readouterr().out


def test_rows_that_name_no_image_are_counted(tmp_path):
    root = write_flat(tmp_path / "photos", 2)
    table = tmp_path / "cameras.csv"
    row = "SIMPLE_PINHOLE,800 400 300\n"
    table.write_text(HEAD + f"00,{row}" + f"01.png,{row}" + f"photos/00.png,{row}")
    expected = "line 2: row '00' matches no image, .*; 2 of 3 rows are so; a row has a path below"
    with pytest.raises(UserError, match=expected):
        read_intrinsics_table(table, root, sorted(root.iterdir()))
