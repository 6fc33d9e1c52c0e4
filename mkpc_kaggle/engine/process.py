"""Workers on this machine: in a thread of the engine's process, or in separate processes.

No call of the engine blocks: a thread for each worker does the blocking calls. No lock is shared with a process,
nothing large goes through its start-up pipe, and its end of the other pipe is closed here. So it may die, be
stopped or be killed at any moment: a write to it, or a read, ends with it.

pebble, which keeps pools of processes, was rejected: it times jobs by the wall clock, and a worker that is killed
during an answer keeps the lock of all others.
"""

import ctypes
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import cast

from mkpc_kaggle.engine.console import unblocked
from mkpc_kaggle.engine.jobs import Answer, Cause, Failure, Job
from mkpc_kaggle.engine.worker import Executor, Maker, Message, Runner, failure_of

# For PyTorch, which reads them once. Threads of OpenMP that wait for each other sleep; by default they spin, and
# keep the cores from decoding, MAGSAC and other processes (python -m benchmarks.threads). Tensors of 2 MiB and
# more come in huge pages, on Linux: in small ones allocating a feature map takes as long as some convolutions.
WORKER_ENVIRONMENT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "THP_MEM_ALLOC_ENABLE": "1"}
_environment = threading.Lock()
PR_SET_PDEATHSIG = 1  # of Linux's prctl
EXIT_TIMEOUT_S = 5.0  # a process's pipe closes before the process has ended


class ThreadWorker:
    """Does jobs, one at a time, in a thread of this process. No call blocks, even if the worker hangs.

    It answers the maker of its runner, with :class:`Loaded` or :class:`Failure`, and each job once. ``on_answer``
    is called in its thread for each answer. It is not used again after a failure of its place, nor after ``kill``.

    A matcher that hangs or crashes cannot be contained here, and a failed device does not recover. Both need
    processes.
    """

    def __init__(self, name: str, make: Maker, on_answer: Callable[[], None]) -> None:
        self.name, self._on_answer = name, on_answer
        self._executor = Executor()
        self._messages: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._killed = False
        self.thread = threading.Thread(target=self._live, name=name, daemon=True)
        self._messages.put(make)

    def start(self) -> None:
        try:
            self.thread.start()
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

    def _exchange(self, message: Message) -> Answer:
        return self._executor.answer(message)


class ProcessWorker(ThreadWorker):
    """A worker process, started with ``spawn`` for the first message. Messages can be pickled."""

    _process: SpawnProcess | None = None

    def kill(self) -> None:
        super().kill()
        if self._process is not None:
            self._process.kill()

    def _exchange(self, message: Message) -> Answer:
        """Return the answer to a message, or how the process ended."""
        if self._process is None:
            self._process, self._pipe = spawn(self.name)
            if self._killed:  # before there was a process to kill
                self._process.kill()
        try:
            self._pipe.send(message)
            answer: Answer = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(timeout=EXIT_TIMEOUT_S)
            self._pipe.close()
            code = self._process.exitcode
            how = f"exit status {code}" if code is None or code >= 0 else f"signal {signal.Signals(-code).name}"
            return Failure(Cause.DIED, how)
        except Exception as error:  # an object that cannot be pickled
            self._process.kill()
            return failure_of(error)
        return answer


def spawn(name: str) -> tuple[SpawnProcess, Connection]:
    """Start a process that serves the other end of the returned pipe.

    It has :data:`WORKER_ENVIRONMENT`, except variables that the user has set. They are removed again here, where
    the OpenMP library is loaded already. It ignores Ctrl-C, which a terminal sends to all, and SIGTERM: its parent
    handles both, and ends it.
    """
    context = multiprocessing.get_context("spawn")
    pipe, its_pipe = context.Pipe()
    process = context.Process(target=serve, args=(its_pipe,), name=name, daemon=True)
    resource_tracker.ensure_running()  # started with the first process, it would unblock the signals
    with its_pipe, _environment, ExitStack() as restored:
        for variable in WORKER_ENVIRONMENT.keys() - os.environ.keys():
            os.environ[variable] = WORKER_ENVIRONMENT[variable]
            restored.callback(os.environ.pop, variable)
        if hasattr(signal, "pthread_sigmask"):  # not on Windows
            former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
            restored.callback(signal.pthread_sigmask, signal.SIG_SETMASK, former)
        process.start()
    return process, pipe


def serve(pipe: Connection) -> None:
    """Serve as a worker process: answer one message after another, the maker of the runner first."""

    def make() -> Runner:
        return cast(Maker, pipe.recv())()  # an object that cannot be unpickled is an answer, too

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
