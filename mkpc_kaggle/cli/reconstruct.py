"""The command ``reconstruct``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.images import READ_SUFFIXES
from mkpc_kaggle.recipe import CameraSharing
from mkpc_kaggle.reconstruction.folder import require_folder
from mkpc_kaggle.reconstruction.outputs import WORK
from mkpc_kaggle.reconstruction.run import reconstruct
from mkpc_kaggle.signals import interruptible

HELP = f"""\
Match the photographs below a folder ({", ".join(READ_SUFFIXES)}) with the engine that makes submissions, and
reconstruct their cameras. Photographs of several scenes may be mixed: each scene becomes a model, and unrelated
photographs get no camera.

OUT gets:
  database.db     COLMAP's: cameras, images, keypoints, matches, verified two-view geometries
  models/0, 1...  COLMAP's binary models, the largest first
  cameras.csv     image, model, K, R, t: X_cam = R X + t, (0, 0) is the first pixel's centre; numbers joined by ;
                  the number of points, and the camera with COLMAP's model and parameters
  images/         links to the photographs, undistorted copies where a lens is distorted
  sparse/0, 1...  the models for images/, with colours of points: for Gaussian splatting
  report.html     the run
  work/           the journal: after a kill, the same command resumes the run and makes the same models

OUT must be empty, or of an earlier run of this command: the names above are replaced. Points refer to the pixels
of the stored file, as COLMAP reads it, without the EXIF orientation. If photographs are added, the models keep
the coordinates of models/0 of the last complete run.

All pairs of up to 200 photographs are matched. Of more, each is matched with the 20 most similar.
Without weights, recipe auto runs one unit of RootSIFT here, and enlarges no image: three units cost three times
as much, and their cameras are hardly better.

Exit status: 0 done; 1 no photograph has a camera, or a result was not written; 2 bad input; 130 or 143 ended by a
signal.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    # Checked here: of `*.jpg`, the first path is refused before argparse lists the others.
    add("images", type=require_folder, metavar="DIR", help="the folder of photographs")
    add("--out", type=Path, required=True, metavar="OUT", help="folder for the results")
    options.add_matching(parser)
    options.add_run(parser, time_limit=None)
    text = "match only these: two paths below DIR per line"
    add("--pairs", type=Path, metavar="FILE", help=text)
    text = """images of one size that share a camera: if their focal lengths agree (auto), none (image), or all
        (folder)"""
    add("--camera", choices=list(map(str, CameraSharing)), help=text)
    text = """known cameras, which are held: a table with the columns image (a path, a name or a pattern such as
        'drone*.jpg'), camera_model (COLMAP's), width, height, and parameters in COLMAP's order, with blanks
        between; a cameras.csv is one"""
    add("--intrinsics", type=Path, metavar="FILE.csv", help=text)
    text = "masks named as COLMAP's, MASKS/a.jpg.png for a.jpg; points on black pixels are left out"
    add("--masks", type=Path, metavar="MASKS", help=text)
    add(
        "--fresh",
        action="store_true",
        help="delete the journal and the scenes of an earlier run in OUT/work",
    )


def run(arguments: argparse.Namespace) -> int:
    with (
        interruptible() as interrupt,
        options.watched_session(arguments, arguments.out / WORK, interrupt) as session,
    ):
        reconstruct(
            arguments.images,
            arguments.out,
            arguments.recipe,
            weights=arguments.weights,
            device=arguments.device,
            precision=arguments.precision,
            settings=options.settings_of(arguments),
            camera=arguments.camera,
            pairs=arguments.pairs,
            intrinsics=arguments.intrinsics,
            masks=arguments.masks,
            session=session,
        )
        return session.status
