"""A reconstruction in a process of its own on this machine."""

import multiprocessing
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from mkpc_kaggle.engine.exits import how_it_ended
from mkpc_kaggle.engine.pools.spawn import signals_blocked
from mkpc_kaggle.engine.scenes import SceneAnswer, SceneJob, reconstruct


class SceneProcess:
    """A job under way; see :class:`mkpc_kaggle.engine.scenes.Reconstruction`.

    The job goes through a pipe whose other end is closed here, and a thread waits on it: a pipe blocks its writer
    as soon as 64 kB wait in it, for ever where the reader is stopped, or dead with its end still open here.
    """

    def __init__(self, job: SceneJob) -> None:
        self._job = job
        self._answer: SceneAnswer | str | None = None
        context = multiprocessing.get_context("spawn")
        self._pipe, its_pipe = context.Pipe()
        self._process: SpawnProcess = context.Process(
            target=begin, args=(serve_scene, its_pipe), name="mkpc scene", daemon=True
        )
        try:
            with signals_blocked():
                self._process.start()
        except OSError as error:  # no memory, or no process more
            self._pipe.close()
            self._answer = f"its process cannot be started: {error}"
            return
        finally:
            its_pipe.close()
        threading.Thread(target=self._ask, name="scene", daemon=True).start()

    def answer(self) -> SceneAnswer | str | None:
        return self._answer

    def kill(self) -> None:
        if self._process.pid is not None:
            self._process.kill()
            self._process.join(timeout=1.0)

    def _ask(self) -> None:
        try:
            self._pipe.send(self._job)
            self._answer = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(timeout=5.0)  # its pipe closes before it has ended
            self._answer = f"its process ended: {how_it_ended(self._process)}"
        finally:
            self._pipe.close()


def begin(serve: Callable[[SceneJob, Connection], None], pipe: Connection) -> None:
    """The life of the process."""
    serve(pipe.recv(), pipe)


def serve_scene(job: SceneJob, answers: Connection) -> None:
    """Do the job."""
    answers.send(reconstruct(job))
