"""Seconds of ``reconstruct`` next to pycolmap alone, on the same folders of images.

    python -m benchmarks.folder_seconds --images DIR... [--code NAME=CHECKOUT...] [--rounds N]
        [--mappers incremental global] [--recipe NAME] [--render N]

The programs alternate. Each runs in a separate process with one thread per library. Its seconds are
CPU seconds of that process and of all processes that it started. pycolmap has its default settings,
and one SIMPLE_PINHOLE camera per image as ``reconstruct`` has. ``reconstruct`` also writes its
tables and its report. ``--code`` adds other versions of this package, such as
``before=../checkout``. ``--render`` first fills the folder with N rendered photographs of one
courtyard, taken on a walk.

The column "MB" has the resident memory of the largest process. The column "mapping" has CPU seconds
of pycolmap alone, and seconds by the clock of ``reconstruct``, with the start of the process.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

import cv2
import numpy as np

from mkpc_kaggle import results
from mkpc_kaggle.demo.camera import look_at
from mkpc_kaggle.demo.render import render
from mkpc_kaggle.demo.world import build_world
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.progress import counted

HERE = Path(__file__).resolve().parents[1]
# A library with more threads waits actively, which would count as work.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
RENDERED = (768, 576)  # width and height of a rendered photograph, in pixels
RENDERED_FOCAL = 0.9  # over the width
ALONE = "from benchmarks.folder_seconds import pycolmap_alone; pycolmap_alone(*__import__('sys').argv[1:])"


@dataclass(frozen=True)
class Program:
    """A way to get cameras: its name in the table, and a command for a folder and an output."""

    name: str
    command: tuple[str, ...]
    checkout: Path = HERE

    def run(self, images: Path, out: Path) -> tuple[float, float]:
        """Run the program. Return the CPU seconds of it and of children that it waited for, and the
        memory of the largest of them in MB.
        """
        command = [part.format(images=images, out=out) for part in self.command]
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(self.checkout)}
        # From the checkout, because Python imports from the working directory first.
        process = subprocess.Popen(
            command,
            env=environment,
            cwd=self.checkout,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{self.name}: exit status {process.returncode} on {images}")
        return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def write_rendered(folder: Path, count: int) -> None:
    """Write photographs of one camera, of a demo world on a walk from its west to its east side."""
    folder.mkdir(parents=True, exist_ok=True)
    surfaces, _ = build_world("courtyard")
    focal = RENDERED_FOCAL * RENDERED[0]
    for number in counted(range(count), "rendering", "image"):
        along = number / max(1, count - 1)
        # Back and forth, and up and down, as of a person who looks for views
        position = (18 * along - 9, -4 + 3 * np.sin(9 * along), 1.7 + np.sin(23 * along) ** 2)
        camera = look_at(position, (8 * along - 4, 20, 4), focal, RENDERED)
        picture, _ = render(surfaces, camera)
        cv2.imwrite(str(folder / f"walk{number:04d}.jpg"), picture.round().astype(np.uint8))


def pycolmap_alone(images: str, out: str, mapper: str) -> None:
    """Reconstruct a folder with pycolmap's features, matching of pairs and mapper."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    database = Path(out) / "database.db"
    Path(out).mkdir(parents=True, exist_ok=True)
    reader = pycolmap.ImageReaderOptions({"camera_model": "SIMPLE_PINHOLE"})
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=pycolmap.FeatureExtractionOptions({"num_threads": 1}),
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions({"num_threads": 1})
    pycolmap.match_exhaustive(database, matching, device=pycolmap.Device.cpu)
    matched = time.process_time()
    if mapper == "incremental":
        options = pycolmap.IncrementalPipelineOptions({"num_threads": 1})
        models = pycolmap.incremental_mapping(database, images, out, options)
    else:
        global_options = pycolmap.GlobalPipelineOptions({"num_threads": 1})
        models = pycolmap.global_mapping(database, images, out, global_options)
    placed = {image for model in models.values() for image in model.reg_image_ids()}
    facts = {"cameras": len(placed), "mapping": time.process_time() - matched}
    (Path(out) / "facts.json").write_text(json.dumps(facts))


def facts_of(out: Path) -> tuple[int, float]:
    """Return the number of cameras, and the seconds of mapping, from the results in ``out``."""
    if (out / "facts.json").exists():
        facts = json.loads((out / "facts.json").read_text())
        return facts["cameras"], facts["mapping"]
    # Another version's journal is refused.
    try:
        found = results(out / "work").scenes
        return int(found["cameras"].sum()), float(found["seconds"].sum())
    except UserError:
        lines = (out / "cameras.csv").read_text(encoding="utf-8").splitlines()
        return len(lines) - 1, nan


def programs_of(arguments: argparse.Namespace) -> list[Program]:
    """Return the programs to compare: pycolmap alone first, then this package's versions."""
    python = sys.executable
    alone = [
        Program(f"pycolmap, {mapper}", (python, "-c", ALONE, "{images}", "{out}", mapper))
        for mapper in arguments.mappers
    ]
    package = (python, "-m", "mkpc_kaggle")
    command = (
        *package,
        "reconstruct",
        "{images}",
        "--out",
        "{out}",
        "--recipe",
        arguments.recipe,
    )
    ours = [Program("reconstruct", command)]
    for each in arguments.code:
        name, _, checkout = each.partition("=")
        ours.append(Program(f"reconstruct, {name}", command, Path(checkout).resolve()))
    return [*alone, *ours]


def measure(programs: Sequence[Program], folder: Path, rounds: int) -> None:
    """Print a row per program and round: CPU seconds, mapping, cameras; then the means."""
    used: dict[str, list[float]] = {program.name: [] for program in programs}
    for number in range(1, rounds + 1):
        # In turns, so that other work on the machine meets all programs.
        for program in programs:
            # A new folder each time: a second run would resume the first one.
            with tempfile.TemporaryDirectory() as name:
                out = Path(name) / "out"
                seconds, memory = program.run(folder.resolve(), out)
                cameras, mapping = facts_of(out)
            used[program.name].append(seconds)
            print(
                f"{folder.parent.name + '/' + folder.name:<28}{program.name:<26}{number:>6}"
                f"{seconds:>8.1f}{memory:>7.0f}{mapping:>9.1f}{cameras:>9}",
                flush=True,
            )
    means = ", ".join(f"{name} {np.mean(seconds):.1f}" for name, seconds in used.items())
    print(f"means: {means}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, nargs="+", required=True)
    parser.add_argument("--code", nargs="*", default=[], metavar="NAME=CHECKOUT")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument(
        "--mappers", nargs="*", default=["incremental", "global"], help="of pycolmap alone"
    )
    parser.add_argument("--recipe", default="auto")
    parser.add_argument(
        "--render", type=int, metavar="N", help="into the new folder of --images"
    )
    arguments = parser.parse_args()
    if arguments.render:
        write_rendered(arguments.images[0], arguments.render)
    print(
        f"{'folder':<28}{'program':<26}{'round':>6}{'CPU s':>8}{'MB':>7}{'mapping':>9}{'cameras':>9}"
    )
    for folder in arguments.images:
        measure(programs_of(arguments), folder, arguments.rounds)


if __name__ == "__main__":
    main()
