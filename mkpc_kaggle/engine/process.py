"""Workers on this machine: in a thread of the engine's process, or in separate processes.

No call of the engine blocks: a thread for each worker does the blocking calls. No lock is shared with a process,
nothing large goes through its start-up pipe, and its end of the other pipe is closed here. So it may die, be
stopped or be killed at any moment: a write to it, or a read, ends with it.

pebble, which keeps pools of processes, was rejected. It times jobs by the wall clock, which may jump. Its workers
share a pipe and its lock, so a worker that is killed during an answer blocks all others.
"""

import ctypes
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import cast

from mkpc_kaggle.engine.jobs import Answer, Cause, Failure, Job
from mkpc_kaggle.engine.streams import unblocked
from mkpc_kaggle.engine.worker import Executor, Runner, failure_of

# For PyTorch, which reads them once. Threads of OpenMP that wait for each other sleep; by default they spin, and
# keep the cores from decoding, MAGSAC and other processes (python -m benchmarks.threads). Tensors of 2 MiB and
# more come in huge pages, on Linux: in small ones allocating a feature map takes as long as some convolutions.
WORKER_ENVIRONMENT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "THP_MEM_ALLOC_ENABLE": "1"}
PR_SET_PDEATHSIG = 1  # of Linux's prctl
EXIT_TIMEOUT_S = 5.0  # a process's pipe closes before the process has ended


class ThreadWorker:
    """Does jobs, one at a time, in a thread of this process. No call blocks, even if the worker hangs.

    It answers the maker of its runner, with :class:`Loaded` or :class:`Failure`, and each job once. ``on_answer``
    is called in its thread for each answer. It is not used again after a failure of its place, nor after ``kill``.

    A matcher that hangs or crashes cannot be contained here, and a failed device does not recover. Both need
    processes.
    """

    def __init__(self, name: str, make: Callable[[], Runner], on_answer: Callable[[], None]) -> None:
        self.name, self._on_answer = name, on_answer
        self._executor = Executor()
        self._messages: queue.SimpleQueue[Callable[[], Runner] | Job | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._killed = False
        self._thread = threading.Thread(target=self._live, name=name, daemon=True)
        self._messages.put(make)

    def start(self) -> None:
        try:
            self._thread.start()
        except RuntimeError as error:  # no thread more
            self._answers.put(Failure(Cause.NOT_STARTED, str(error)))

    def submit(self, job: Job) -> None:
        self._messages.put(job)

    def answer(self) -> Answer | None:
        """Return an answer once; ``None`` while it computes."""
        with suppress(queue.Empty):
            return self._answers.get_nowait()
        return None

    def kill(self) -> None:
        self._killed = True
        self._messages.put(None)

    def _live(self) -> None:
        while (message := self._messages.get()) is not None and not self._killed:
            try:
                answer = self._exchange(message)
            except Exception as error:  # out of memory, or of processes
                answer = Failure(Cause.NOT_STARTED, str(error))
            self._answers.put(answer)
            self._on_answer()

    def _exchange(self, message: Callable[[], Runner] | Job) -> Answer:
        return self._executor.answer(message)


class ProcessWorker(ThreadWorker):
    """A worker process, started with ``spawn`` for the first message. Messages can be pickled."""

    _process: SpawnProcess | None = None

    def kill(self) -> None:
        super().kill()
        if self._process is not None:
            self._process.kill()

    def _exchange(self, message: Callable[[], Runner] | Job) -> Answer:
        """Return the answer to a message, or how the process ended."""
        process = self._process or self._started()
        try:
            self._pipe.send(message)
            answer: Answer = self._pipe.recv()
        except (EOFError, OSError):
            process.join(timeout=EXIT_TIMEOUT_S)
            self._pipe.close()
            return Failure(Cause.DIED, how_it_ended(process.exitcode))
        except Exception as error:  # an object that cannot be pickled
            process.kill()
            return failure_of(error)
        return answer

    def _started(self) -> SpawnProcess:
        context = multiprocessing.get_context("spawn")
        self._pipe, its_pipe = context.Pipe()
        process = context.Process(target=serve, args=(its_pipe,), name=self.name, daemon=True)
        try:
            with worker_environment():
                process.start()
        finally:
            its_pipe.close()
        self._process = process
        if self._killed:  # before there was a process to kill
            process.kill()
        return process


def how_it_ended(code: int | None) -> str:
    return f"exit status {code}" if code is None or code >= 0 else f"signal {signal.Signals(-code).name}"


_environment = threading.Lock()


@contextmanager
def worker_environment() -> Iterator[None]:
    """Start processes with :data:`WORKER_ENVIRONMENT`, except variables that the user has set.

    It is removed again here, where the OpenMP library is loaded already. These processes ignore Ctrl-C, which a
    terminal sends to all, and SIGTERM: their parent handles both, and ends them.
    """
    resource_tracker.ensure_running()  # started with the first process, it would unblock them
    with _environment, ExitStack() as restored:
        ours = {name: value for name, value in WORKER_ENVIRONMENT.items() if name not in os.environ}
        os.environ.update(ours)
        for name in ours:
            restored.callback(os.environ.pop, name)
        if hasattr(signal, "pthread_sigmask"):  # not on Windows
            former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
            restored.callback(signal.pthread_sigmask, signal.SIG_SETMASK, former)
        yield


def serve(pipe: Connection) -> None:
    """Serve as a worker process: answer one message after another, the maker of the runner first."""

    def make() -> Runner:
        return cast(Callable[[], Runner], pipe.recv())()  # an object that cannot be unpickled is an answer, too

    end_with_parent()
    executor, message = Executor(), make
    with unblocked(), suppress(EOFError, OSError):  # the parent is gone
        while True:
            pipe.send(executor.answer(message))
            message = pipe.recv()


def end_with_parent() -> None:
    """End this process with its parent, even during a computation.

    On Linux it ends with the thread that started it, even if it is stopped.
    """
    with suppress(OSError, AttributeError):  # elsewhere
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)

    def wait() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
