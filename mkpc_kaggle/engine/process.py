"""Workers on this machine: in a thread of the engine's process, or in separate processes.

No call of the engine blocks: each worker has a thread for blocking calls. A worker process shares
no lock, gets nothing large through its start-up pipe, and is alone in holding its end of the
message pipe. So it may die, be stopped or be killed at any moment: reads and writes that wait for
it end with it.

Process pools of the package pebble were rejected. They time jobs by the wall clock, and a worker
killed during an answer keeps the lock of all others.
"""

import multiprocessing
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import cast

from mkpc_kaggle.cores import WORKER_ENVIRONMENT
from mkpc_kaggle.engine.request import Answer, Cause, Failure, Job
from mkpc_kaggle.engine.worker import Executor, Maker, Message, Runner, failure_of
from mkpc_kaggle.signals import end_with_parent

_environment = threading.Lock()  # two threads may start processes at a time
EXIT_TIMEOUT_S = 5.0  # for a process to end after its pipe has closed


class ThreadWorker:
    """A worker that does one job at a time in a thread of this process. No call blocks, even if the
    worker hangs.

    The first answer, to the runner's maker, is :class:`Loaded` or :class:`Failure`. Then each job
    gets one answer. The thread calls ``on_answer`` after each. A worker is not used again after
    ``kill`` or a failure of its place.

    A thread cannot contain a matcher that hangs or crashes, and cannot recover from a failed
    device. Both need processes.
    """

    def __init__(
        self,
        name: str,
        make: Maker,
        on_answer: Callable[[], None],
        log: Path | None = None,
    ) -> None:
        self.name = name
        self.log = log  # of native libraries' text, for a process; None: it is dropped
        self._on_answer = on_answer
        self._executor = Executor()
        self._messages: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._killed = False  # it may be killed while its process is still starting
        self.thread = threading.Thread(target=self._live, name=name, daemon=True)
        self._messages.put(make)

    def start(self) -> None:
        try:
            self.thread.start()
        except RuntimeError as error:  # no more threads
            self._answers.put(Failure(Cause.NOT_STARTED, str(error)))

    def submit(self, job: Job) -> None:
        self._messages.put(job)

    def answer(self) -> Answer | None:
        """Return the next answer, each once; ``None`` while the worker computes."""
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
            except Exception as error:  # out of memory, or no more processes
                answer = Failure(Cause.NOT_STARTED, str(error))
            self._answers.put(answer)
            self._on_answer()

    def _exchange(self, message: Message) -> Answer:
        return self._executor.answer(message)


class ProcessWorker(ThreadWorker):
    """A worker process, started with ``spawn`` at the first message. Messages must be picklable."""

    _process: SpawnProcess | None = None

    def kill(self) -> None:
        super().kill()
        if self._process is not None:
            self._process.kill()

    def _exchange(self, message: Message) -> Answer:
        """Return the answer to a message, or a :class:`Failure` that states how the process ended."""
        # The first message starts the process, in this thread: a start takes seconds.
        if self._process is None:
            self._process, self._pipe = spawn(self.name, self.log)
            if self._killed:  # before the process existed
                self._process.kill()
        try:
            self._pipe.send(message)
            answer: Answer = self._pipe.recv()
        except (EOFError, OSError):
            # The pipe closes before the exit status exists.
            self._process.join(timeout=EXIT_TIMEOUT_S)
            self._pipe.close()
            code = self._process.exitcode
            how = f"exit status {code}"
            if code is not None and code < 0:
                how = f"signal {signal.Signals(-code).name}"
            return Failure(Cause.DIED, how)
        except Exception as error:  # an object that cannot be pickled
            self._process.kill()
            return failure_of(error)
        return answer


def spawn(name: str, log: Path | None = None) -> tuple[SpawnProcess, Connection]:
    """Start a process that serves the other end of the returned pipe. Its output is appended to
    ``log``.

    The new process has :data:`WORKER_ENVIRONMENT`, except variables that the user has set. This
    process does not keep the variables, since its OpenMP library is already loaded. The new process
    ignores SIGTERM and Ctrl-C, which a terminal sends to all processes: the parent handles both
    signals and ends the process.
    """
    # Not by fork: CUDA does not survive it, nor do locks that other threads hold.
    context = multiprocessing.get_context("spawn")
    pipe, its_pipe = context.Pipe()
    process = context.Process(target=serve, args=(its_pipe, log), name=name, daemon=True)
    # If started with the first process, it would unblock the signals
    resource_tracker.ensure_running()
    with its_pipe, _environment, _without_program(), ExitStack() as restored:
        for variable in WORKER_ENVIRONMENT.keys() - os.environ.keys():
            os.environ[variable] = WORKER_ENVIRONMENT[variable]
            restored.callback(os.environ.pop, variable)
        if hasattr(signal, "pthread_sigmask"):  # not on Windows
            former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
            restored.callback(signal.pthread_sigmask, signal.SIG_SETMASK, former)
        process.start()
    return process, pipe


@contextmanager
def _without_program() -> Iterator[None]:
    """Hide the user's program from a new process.

    It would run the program again, to find its classes there. A script that calls
    :func:`mkpc_kaggle.reconstruct` without a guard would call it in each worker.
    """
    program = sys.modules["__main__"]
    former = {name: vars(program).get(name) for name in ("__spec__", "__file__")}
    vars(program).update(dict.fromkeys(former))
    try:
        yield
    finally:
        vars(program).update(former)


def serve(pipe: Connection, log: Path | None = None) -> None:
    """Answer messages in a worker process, one after another; the first is the maker of the runner."""
    # A file never blocks a library that prints, as a pipe without a reader does.
    try:
        output = os.open(log or os.devnull, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    except OSError:  # a full disk
        output = os.open(os.devnull, os.O_WRONLY)
    os.dup2(output, 1)
    os.dup2(output, 2)

    def make() -> Runner:
        return cast(Maker, pipe.recv())()  # unpickling may raise, which is an answer, too

    end_with_parent()
    executor = Executor()
    message = make  # the first; its result is the runner
    with suppress(EOFError, OSError):  # the parent has ended
        while True:
            pipe.send(executor.answer(message))
            message = pipe.recv()
