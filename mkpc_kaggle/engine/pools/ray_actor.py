"""A worker in a Ray actor: its images and weights come from shared paths, or else from the parent's machine."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import ray

from mkpc_kaggle import __version__
from mkpc_kaggle.data.images import Image, ImageStore, Unreadable, decode_image, read_image
from mkpc_kaggle.engine.jobs import Job
from mkpc_kaggle.engine.scenes import SceneAnswer, SceneJob, reconstruct
from mkpc_kaggle.engine.worker import Answer, Worker
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.stages import Pipeline

Stamp = tuple[int, int]
Fetch = Callable[[Path, Stamp | None], bytes | None]


class FileServer:
    """An actor on the parent's machine that reads its files for machines that lack them."""

    def fetch(self, path: Path, stamp: Stamp | None) -> bytes | None:
        """The file's bytes; ``None`` where its stamp is ``stamp``. Raises ``OSError``."""
        return None if stamp is not None and stamp == stamp_of(path) else path.read_bytes()


def stamp_of(path: Path) -> Stamp | None:
    """Size in bytes and time of change in nanoseconds: the same where a path leads to the same file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


class WorkerActor:
    """A worker that says when it was last heard of; ``files`` is the :class:`FileServer`."""

    def __init__(self, assembly: Assembly, threads: int, files: Any) -> None:
        self._assembly = assembly
        self._threads = threads
        self._files = files
        self._last_heartbeat = time.monotonic()
        self._worker = Worker(self._pipeline, ImageStore(read=lambda path: read_or_fetch(path, self._fetch)))

    def load(self, version: str) -> str | UserError:
        """Empty; or what the user has to mend."""
        if version != __version__:
            host = ray.util.get_node_ip_address()
            return UserError(
                f"mkpc-kaggle is {__version__} on {host} and {version} here: install the same on both"
            )
        use_threads(self._threads)
        try:
            self._worker.load()
        except UserError as error:
            return error
        return ""

    def run(self, job: Job, seconds: float) -> Answer:
        self._heartbeat()
        return self._worker.run(job, seconds, self._heartbeat)

    def silent_for(self) -> float:
        """Seconds since it last began something."""
        return time.monotonic() - self._last_heartbeat

    def prefetch(self, paths: tuple[Path, ...]) -> None:
        self._worker.prefetch(paths)

    def stop(self) -> None:
        self._worker.stop()

    def _heartbeat(self) -> None:
        self._last_heartbeat = time.monotonic()

    def _fetch(self, path: Path, stamp: Stamp | None) -> bytes | None:
        return fetch_from(self._files, path, stamp)

    def _pipeline(self) -> Pipeline:
        return self._assembly.pipeline()


class SceneActor:
    """Reconstructs one batch; ``files`` is the :class:`FileServer`."""

    def __init__(self, files: Any) -> None:
        self._files = files

    def reconstruct(self, job: SceneJob) -> SceneAnswer:
        return reconstruct(job, lambda path: read_or_fetch(path, partial(fetch_from, self._files)))


def fetch_from(files: Any, path: Path, stamp: Stamp | None) -> bytes | None:
    """What the :class:`FileServer` answers, see there."""
    found: bytes | None = ray.get(files.fetch.remote(path, stamp))
    return found


def read_or_fetch(path: Path, fetch: Fetch) -> Image | Unreadable:
    """The image at ``path`` of the parent's machine: read here if the path leads to it here too; never raises."""
    try:
        data = fetch(path, stamp_of(path))
    except FileNotFoundError:
        return Unreadable(str(path), "no such file")
    except (OSError, ray.exceptions.RayError) as error:
        return Unreadable(str(path), f"cannot be fetched: {error}")
    return read_image(path) if data is None else decode_image(str(path), np.frombuffer(data, np.uint8))


def use_threads(count: int) -> None:
    import torch

    torch.set_num_threads(count)
    cv2.setNumThreads(count)
