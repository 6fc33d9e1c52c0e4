"""Standard streams that are not read, or that a library uses in its own way, cost neither time nor
a job.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mkpc_kaggle.engine.console import (
    LOG_NAME,
    Event,
    EventKind,
    Progress,
    append_event,
    read_events,
)

ROOT = Path(__file__).resolve().parents[2]
QUIET_LIBRARY = """
import os

def complain():
    os.write(1, b"libpng warning, ")
    os.write(2, b"libjpeg: premature end")
"""
LOGS = """
import sys, threading
from library import complain
from pathlib import Path
from mkpc_kaggle.engine.process import ProcessWorker

answers = threading.Semaphore(0)
worker = ProcessWorker("decoder", complain, answers.release)
worker.log = Path(sys.argv[1])
worker.start()
answers.acquire()
worker.kill()
"""


def test_output_of_native_code_in_a_worker_goes_to_a_file_of_the_run(tmp_path):
    script = tmp_path / "logs.py"
    # Workers import what they run, and not the program that starts them.
    (tmp_path / "library.py").write_text(QUIET_LIBRARY)
    script.write_text(LOGS)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, script, tmp_path / "workers.log"]
    done = subprocess.run(command, env=environment, capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")
    assert (tmp_path / "workers.log").read_bytes() == b"libpng warning, libjpeg: premature end"


UNREAD = """
from mkpc_kaggle.engine.console import Progress, leave, logger, queued

with queued():
    progress = Progress()
    for number in range(20_000):
        progress.count("sweep", number % 2, 2)
        logger.warning("pair %d of 20000 %s", number, 100 * "x")
    print("done", flush=True)
    leave(0, seconds=0.5)
"""


def test_a_stderr_that_is_not_read_costs_lines_and_not_the_run():
    reader, pipe = os.pipe()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", UNREAD]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=pipe, env=environment, check=False, timeout=300
    )
    os.close(pipe)
    os.close(reader)
    assert (done.returncode, done.stdout) == (0, b"done\n")


def test_a_run_that_shows_no_progress_prints_nothing(capsys):
    progress = Progress(is_shown=False)
    progress.count("sweep", 1, 2)
    progress.note("text")
    progress.close()
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("cut", [b"", b"3.0 faul", b"\xff\xfe"])
def test_events_are_lines_of_which_the_last_session_is_read(tmp_path, cut):
    former = [Event(0.0, EventKind.START), Event(1.0, EventKind.FAULT, "of the former session")]
    last = [
        Event(0.1, EventKind.START),
        Event(2.5, EventKind.SCENE, "a: 3 of 4 images \udc80".strip()),
    ]
    for event in [*former, *last]:
        append_event(tmp_path, event)
    with (tmp_path / LOG_NAME).open("ab") as stream:
        stream.write(cut)
    texts = [(event.kind, event.text) for event in read_events(tmp_path)]
    assert texts == [("start", ""), ("scene", r"a: 3 of 4 images \udc80")]
    assert read_events(tmp_path / "none") == []
