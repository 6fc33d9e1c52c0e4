"""One hostile case: a room with an input, the command in it as a separate process, and the allowed
results.
"""

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from processes import started_with
from shared import problem_of

ROOT = Path(__file__).resolve().parents[2]
# Of data, for each process; not of address space, of which CUDA builds of PyTorch reserve more.
MEMORY_KIB = 4 << 20
HANGS_S = 600  # far above the slowest case on a busy machine
REFUSED = (2,)
EITHER = (0, 1, 2)  # a valid result, a result that states what is missing, or a clear refusal
CRASHES = (
    "Traceback (most recent call last)",
    "Fatal Python error",
    "Segmentation fault",
    "core dumped",
)
# A mistake of the case
MISTYPED = ("expected one argument", "unrecognized arguments", "arguments are required")
ENDED_BY_ITSELF = (0, 1, 128 + signal.SIGINT, 128 + signal.SIGTERM)
TOO_LATE = "the time limit passed before the first results"
MARK = "MKPC_HOSTILE_CASE"

Make = Callable[[Path], object]
Act = Callable[["subprocess.Popen[bytes]"], None]


def nothing(_: object) -> None:
    """Leave the room as it is."""


@dataclass(frozen=True)
class Case:
    """``make`` changes the room; ``command`` runs in it under ``limits`` (options of ulimit); ``act`` disturbs it.

    It must end with one of ``statuses``, and its output must contain ``says``. It may write only to the room's
    folder ``out``. A submission, ``out/s.csv``, must be valid and complete unless the command was refused or
    ``submission`` is false. ``then`` is a second command with the same rules.
    """

    group: str
    name: str
    command: str
    make: Make = nothing
    statuses: tuple[int, ...] = (0,)
    says: str = ""
    act: Act | None = None
    then: str = ""
    env: dict[str, str] = field(default_factory=dict)
    limits: str = "-c 0"
    submission: bool = True
    # Opens the descriptor that the command writes to; else the log
    stderr: Callable[[], int] | None = None

    @property
    def id(self) -> str:
        return f"{self.group}: {self.name}"


def attack(case: Case, room: Path) -> None:
    """Run the case in the room. The test fails with all faults."""
    case.make(room)
    before = _snapshot(room)
    faults = []
    for command in filter(None, (case.command, case.then)):
        mark = uuid.uuid4().hex
        process = _start(command, room, {**case.env, MARK: mark}, case.limits, case.stderr)
        # Such as a signal, or a file that is removed during the run
        if command == case.command and case.act is not None:
            case.act(process)
        status, output = _wait(process, room)
        faults += _faults(case, status, output, room)
        faults += [f"left running: {line}" for line in _orphans(mark)]
        # A signal before the program reads its options leaves no file, and cannot.
        was_interrupted = status not in (0, 1) and output.strip() in (
            "",
            "error: interrupted",
        )
        if (
            case.submission
            and not was_interrupted
            and "submit" in command
            and status in ENDED_BY_ITSELF
            and (problem := problem_of(room / "out" / "s.csv", room / "D"))
        ):
            faults.append(f"submission: {problem}")
        if status in (0, 1) and "reconstruct" in command and TOO_LATE not in output:
            faults += _result_faults(room / "out" / "o", status)
    after = _snapshot(room)
    faults += [
        f"changed: {name}"
        for name in sorted(before | after)
        if before.get(name) != after.get(name)
    ]
    if faults:
        lines = [case.id, case.command, *faults, f"output:\n{output[-3000:]}"]
        pytest.fail("\n".join(lines), pytrace=False)


def prepared(command: str, room: Path) -> int:
    """Return the exit status of an undisturbed command."""
    return _start(command, room, {}).wait()


def _start(
    command: str,
    room: Path,
    env: dict[str, str],
    limits: str = "-c 0",
    stderr: Callable[[], int] | None = None,
) -> "subprocess.Popen[bytes]":
    # A hostile file must not take the memory of the machine.
    limited = ["sh", "-c", f'ulimit -d {MEMORY_KIB}; ulimit {limits}; exec "$@"', "sh"]
    own = {
        "PATH": os.defpath,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    # What is written there is listed at the end: a run must leave nothing behind.
    own |= {"HOME": str(room / "home"), "TMPDIR": str(room / "tmp"), "no_proxy": "*"}
    # Its list of fonts is slow
    own["MPLCONFIGDIR"] = str(Path(tempfile.gettempdir()) / "hostile-matplotlib")
    with (room / "out" / "log").open("ab") as log:
        return subprocess.Popen(
            [*limited, sys.executable, "-m", "mkpc_kaggle", *shlex.split(command)],
            cwd=room,
            env=own | env,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=stderr() if stderr else subprocess.STDOUT,
            start_new_session=True,  # so that a case that hangs is killed with its workers
        )


def _wait(process: "subprocess.Popen[bytes]", room: Path) -> tuple[int | None, str]:
    """Return the status, ``None`` if the process had to be killed, and the output."""
    status = None
    try:
        status = process.wait(HANGS_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return status, (room / "out" / "log").read_text(errors="replace")


def _faults(case: Case, status: int | None, output: str, room: Path) -> Iterator[str]:
    yield from (
        f"the output has {crash!r}" for crash in (*CRASHES, *MISTYPED) if crash in output
    )
    if status is None:
        yield f"it hangs: not over after {HANGS_S} s"
    elif status not in case.statuses:
        yield f"exit status {status}, not one of {case.statuses}"
    if status in REFUSED and "error:" not in output:
        yield "refused without a word"
    if case.says not in output:
        yield f"the output has no {case.says!r}"
    if status in (0, 1, 2) and (
        left := sorted(path.name for path in (room / "tmp").iterdir())
    ):
        yield f"left in the folder for temporary files: {left}"


def _result_faults(out: Path, status: int) -> Iterator[str]:
    """Yield the faults of the results of a folder of images."""
    table = out / "cameras.csv"
    lines = table.read_text().splitlines() if table.is_file() else [""]
    if not lines[0].startswith("image,model,K,R,t,"):
        yield f"{table} begins with {lines[0]!r}"
    if status == 0 and len(lines) == 1:
        yield "exit status 0 without a camera"
    if len(lines) == 1 and any(out.rglob("images.bin")):
        yield "no camera in the table, and a model"
    yield from (f"left: {path}" for path in out.rglob(".*") if path.name != ".png")


def _orphans(mark: str) -> list[str]:
    """Kill the processes of the case that still run, and return their command lines."""
    # Workers notice the death of their parent within seconds.
    for _ in range(600):
        if not (left := started_with(mark)):
            break
        time.sleep(0.1)
    for process in left:
        with suppress(OSError):  # it has ended meanwhile
            os.kill(process, signal.SIGKILL)
    return [f"{process} {command[:200]}" for process, command in left.items()]


def _snapshot(room: Path) -> dict[str, tuple[object, ...]]:
    """Return the state of each file and folder of the room, except what a command may write."""
    states = {}
    for folder, folders, names in os.walk(os.fsencode(room)):
        if folder == os.fsencode(room):
            folders[:] = [name for name in folders if name not in (b"out", b"tmp")]
        for name in folders + names:
            path = os.path.join(folder, name)  # noqa: PTH118  bytes: a name may be no text
            status = os.lstat(path)
            contents = (
                (status.st_size, status.st_mtime_ns, status.st_ino) if name in names else ()
            )
            states[repr(path)] = (status.st_mode, *contents)
    return states
