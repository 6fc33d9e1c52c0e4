"""The options of the benchmark that all parts share, and its machine."""

import os
import platform
import subprocess
import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import torch

from benchmarks.gpu.record import Row
from mkpc_kaggle.demo import DemoSet, write_demo

LIBRARIES = ("torch", "numpy", "opencv-python-headless", "opencv-python", "kornia", "pycolmap")
QUICK_SCALE = 0.3  # of the images of the demo set


@dataclass(frozen=True)
class Setup:
    """The device, the folders, and whether this is a short rehearsal."""

    device: str
    quick: bool
    out: Path
    golden: Path | None
    weights: tuple[Path, ...]

    @property
    def is_gpu(self) -> bool:
        return self.device != "cpu"

    def demo(self) -> DemoSet:
        """Return the demo set, rendered on first use: one scene for a rehearsal, else all."""
        directory = self.out / "demo"
        if (directory / "test" / "test.csv").is_file():
            return DemoSet(
                directory, directory / "train", directory / "test", directory / "test_truth.csv"
            )
        if self.quick:
            return write_demo(directory, scenes=["courtyard"], image_scale=QUICK_SCALE)
        return write_demo(directory, scenes=["courtyard", "market"])

    def synchronise(self) -> None:
        """Wait until the device has finished."""
        if self.is_gpu:
            torch.cuda.synchronize(self.device)


def machine(setup: Setup) -> Row:
    """Return the facts about the machine that figures depend on."""
    facts: Row = {"device": setup.device}
    if setup.is_gpu:
        properties = torch.cuda.get_device_properties(setup.device)
        facts["GPU"] = properties.name
        facts["GPU memory"] = f"{properties.total_memory / 2**30:.1f} GiB"
        facts["compute capability"] = f"{properties.major}.{properties.minor}"
        facts["driver"] = _driver()
        facts["CUDA of torch"] = torch.version.cuda
        facts["cuDNN"] = torch.backends.cudnn.version()  # type: ignore[no-untyped-call]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    facts["cores"] = cores
    facts["Python"] = platform.python_version()
    for name in LIBRARIES:
        facts[name] = _version(name)
    facts["quick"] = setup.quick
    facts["time"] = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return {name: value for name, value in facts.items() if value is not None}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _driver() -> str:
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.SubprocessError) as error:
        return f"unknown ({type(error).__name__})"
    return done.stdout.split("\n")[0]
