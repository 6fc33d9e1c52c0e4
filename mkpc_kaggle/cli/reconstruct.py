"""The command ``reconstruct``."""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.hloc import SUFFIX, require_h5py
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.engine.session import interruptible
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.intrinsics import Rows
from mkpc_kaggle.recipe import CameraSharing
from mkpc_kaggle.reconstruction.coordinates import keep_coordinates
from mkpc_kaggle.reconstruction.directory import (
    WORK,
    output_directory,
    require_directory_apart,
)
from mkpc_kaggle.reconstruction.export import export_matches
from mkpc_kaggle.reconstruction.folder import (
    Datasets,
    Ends,
    pair_list_line,
    read_folder,
    read_pair_list,
)
from mkpc_kaggle.reconstruction.layout import write_layouts
from mkpc_kaggle.reconstruction.outputs import SUBMISSION_FORMATS, Cameras, write_tables
from mkpc_kaggle.reconstruction.panoramas import require_perspective
from mkpc_kaggle.reconstruction.priors import (
    crops_line,
    intrinsics_line,
    read_intrinsics_table,
)
from mkpc_kaggle.reconstruction.run import FolderResult, for_cameras, reconstruct_folder
from mkpc_kaggle.reporting.summary import summary, trouble

HELP = """\
Match the images of a folder with the engine that makes submissions, and reconstruct their cameras. Each folder
in DIR with images is a separate dataset, and the images directly in DIR are another; with --join, all are one.
Images of several scenes may be mixed: each scene becomes a model, and unrelated images get no camera.

OUT gets a folder for each folder in DIR, with:
  database.db     COLMAP's: cameras, images, keypoints, matches, verified two-view geometries
  models/0, 1...  COLMAP's binary models, the largest first
  images/         links to the images, or copies where links fail
  sparse/0, 1...  the models with plain file names and colours, as gsplat, nerfstudio and others read them
and for all datasets together:
  cameras.csv     image, model, K, R, t: X_cam = R X + t, (0, 0) is the first pixel's centre; numbers joined by ;
                  and the number of points that each image sees
  submission.csv  with --format
  report.html     the run, with the cameras and points of each scene in 3D if plotly is installed
  work/           the journal: after a kill, the same command resumes the run and makes the same files

Points refer to the pixels of the stored file, as COLMAP reads it, without the EXIF orientation. A file that EXIF
calls mirrored (2, 4, 5, 7) is matched as stored, so it rarely matches files that are not mirrored.
Cameras start with the focal lengths of EXIF.

OUT must be empty or the result of an earlier run of this command. Complete new results replace former results; a
link or a file of yours at the path of a result is refused. At the end, unchanged results that only an earlier run
made are removed. Other files remain.

If images were added or removed since the last complete run, the cameras keep its coordinates; with --fresh they
do not.

All pairs of up to 40 images are matched. Of up to 200, pairs whose largest keypoints do not match are left out,
unless most pairs have matches. In larger datasets, each image is matched with the 20 most similar.
Without weights, recipe auto runs one unit of RootSIFT here, and enlarges no image: three units cost three times
as much, and their cameras are hardly better.

Exit status: 0 done; 1 no image has a camera, a dataset has only an earlier run's cameras, a result was not
written, or the run failed; 2 bad input; 130 or 143 ended by a signal.
"""
MAX_LINES = 20  # printed of each list


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("images", type=Path, metavar="DIR", help="png, jpg or jpeg files, or folders of them")
    add(
        "--out",
        type=Path,
        required=True,
        metavar="OUT",
        help="directory for the results: empty, or of an earlier run",
    )
    options.add_matching(parser)
    options.add_run(parser, time_limit=None)
    add(
        "--pairs",
        type=Path,
        metavar="FILE",
        help="match only these: two paths below DIR per line, as in hloc",
    )
    text = "also write keypoints and matches of all images to this file, in hloc's layout"
    add("--export", type=Path, metavar="FILE.h5", help=text)
    text = "all images below DIR are one dataset, such as the folders of one camera's cards"
    add("--join", action="store_true", help=text)
    add(
        "--format",
        choices=SUBMISSION_FORMATS,
        help="also write submission.csv; imc2023 is also for 2024",
    )
    add(
        "--rotations",
        action="store_true",
        help="try images without matches turned by 90, 180 and 270 degrees",
    )
    text = """images of one size in a folder that share a camera: if their focal lengths agree (auto), none
        (image), or all (folder)"""
    add("--camera", choices=list(map(str, CameraSharing)), help=text)
    text = """known cameras, a table with the columns image (a path, a name or a pattern such as 'drone*.jpg'),
        model (COLMAP's: SIMPLE_PINHOLE, OPENCV, ...), parameters (in COLMAP's order, separated by blanks),
        and optionally size (of the images: 1536x1024)"""
    add("--intrinsics", type=Path, metavar="FILE.csv", help=text)
    text = "masks named as COLMAP's, MASKS/a.jpg.png for a.jpg; points on black pixels are left out"
    add("--masks", type=Path, metavar="MASKS", help=text)
    add("--fresh", action="store_true", help="delete the journal of an earlier run in OUT/work")
    # The recipe's scenes, even if its file has none
    parser.set_defaults(reconstruct=True)


def run(arguments: argparse.Namespace) -> int:
    root = arguments.images
    out = arguments.out
    work_dir = out / WORK
    datasets = read_folder(root, join=arguments.join)
    files = [file for dataset in datasets.values() for file in dataset]
    # All inputs are read and checked before OUT is touched.
    require_perspective(files)
    known_cameras: Rows = ()
    if arguments.intrinsics is not None:
        known_cameras = read_intrinsics_table(arguments.intrinsics, root, files)
    masks = Masks() if arguments.masks is None else Masks.of_folder(arguments.masks, root, files)
    more = [arguments.pairs, arguments.intrinsics, arguments.masks]
    inputs = [root, options.recipe_file(arguments), *more]
    require_directory_apart(out, filter(None, inputs), arguments.weights)
    if arguments.export is not None:
        _require_export(arguments.export, [path for path in inputs if path], work_dir)
    listed = None if arguments.pairs is None else read_pair_list(arguments.pairs, root, datasets)
    with (
        interruptible() as interrupt,
        options.watched_session(arguments, work_dir, interrupt) as session,
        output_directory(out, datasets, arguments.format) as held,
    ):
        session.status = 1  # until a model exists

        def publish(cameras: Cameras) -> None:
            held.check()
            write_tables(out, cameras, root, arguments.format)
            session.status = int(not any(any(dataset.values()) for dataset in cameras.values()))

        assembly = options.assembly_of(arguments, arguments.recipe, arguments.mode, interrupt)
        recipe = for_cameras(assembly.recipe, arguments.camera)
        assembly = replace(assembly, recipe=recipe, masks=masks, cameras=known_cameras)
        effects = [*_effects(masks, known_cameras, listed, root, datasets)]
        options.say_start(plural(len(files), "image"), assembly, work_dir, effects)
        result = reconstruct_folder(
            root,
            datasets,
            assembly,
            session,
            out,
            listed=listed,
            rotations=arguments.rotations,
            publish=publish,
        )
        # A run that failed has failed even if an earlier one has left a model.
        unwritten = result.report.unwritten or result.report.unsaved
        if trouble(result.report) or unwritten or result.lost or result.earlier:
            session.status = 1
        lines = [summary(result.report)]
        is_here = held.is_here and all(held_files.is_here for held_files in result.held.values())
        if is_here:
            written, problems = _write_more(arguments, datasets, result, session.must_end())
            lines += written
        else:
            # The directory that has the name now is the user's.
            problems = [f"{out} was moved or replaced during the run; no more is written there"]
        if problems:
            session.status = 1
        lines += [*problems, result.report.unwritten, f"results: {out}"]
        logger.info("\n".join(filter(None, lines)))
        # A run without pairs has no report.
        page = out / "report.html" if result.pairs and is_here else None
        return options.finish(session, page, result.pairs)


def _write_more(
    arguments: argparse.Namespace, datasets: Datasets, result: FolderResult, ends: float
) -> tuple[list[str], list[str]]:
    """Write the files for other programs until ``ends``, and the coordinates for the next run.

    Return lines about them, and the problems. A file that cannot be written costs no other one, and neither
    the summary nor the report.
    """
    root = arguments.images
    out = arguments.out
    if any(any(dataset.values()) for dataset in result.cameras.values()):
        logger.info("writing images/ and sparse/ for other programs")
    lines: list[str] = []
    problems = [*write_layouts(out, root, datasets, ends, result.held)]
    with _adding_problem(problems):
        lines += keep_coordinates(out, root, result)
    if arguments.export is not None:
        with _adding_problem(problems):
            lines.append(export_matches(arguments.export, out, datasets))
    return lines, problems


@contextmanager
def _adding_problem(problems: list[str]) -> Iterator[None]:
    """Add the text of a :class:`UserError` in the block to ``problems``."""
    try:
        yield
    except UserError as error:
        problems.append(str(error))


def _require_export(path: Path, inputs: Sequence[Path], work_dir: Path) -> None:
    """Raise :class:`UserError` before hours of matching if the file cannot be written after them."""
    if path.suffix != SUFFIX:
        raise UserError(f"--export {path}: the name must end in {SUFFIX}")
    require_h5py()
    require_apart({"--export": path}, inputs, work_dir)


def _effects(
    masks: Masks, cameras: Rows, listed: Sequence[Ends] | None, root: Path, datasets: Datasets
) -> Iterator[str]:
    """Yield which part of the masks, the known cameras and the list of pairs takes effect, and a line
    on photographs that are crops.
    """
    files = [file for dataset in datasets.values() for file in dataset]
    if masks.line:
        yield masks.line
    if cameras:
        yield intrinsics_line(cameras, root, files)
    if line := crops_line(cameras, root, files):
        yield line
    if listed is not None:
        yield pair_list_line(listed, root, datasets)
