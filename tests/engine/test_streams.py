"""Standard streams that are not read, or that a library uses in its own way, cost neither time nor
a job.
"""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mkpc_kaggle.engine.console import logger

ROOT = Path(__file__).resolve().parents[2]
# Workers import what they run, and not the program that starts them.
LIBRARY = """
import os

def complain():
    for number in range(3000):
        os.write({descriptor}, b"libpng warning: iCCP: known incorrect sRGB profile, number %d" % number)
"""
COMPLAINS = """
import os, threading
from library import complain
from mkpc_kaggle.engine.jobs import Loaded
from mkpc_kaggle.engine.workers.process import ProcessWorker
from mkpc_kaggle.engine.console import unblocked

with unblocked():
    if {in_worker}:
        answers = threading.Semaphore(0)
        worker = ProcessWorker("decoder", complain, answers.release)
        worker.start()
        answers.acquire()
        assert worker.answer() == Loaded()
        worker.kill()
    else:
        complain()
os.write({done}, b"done")
os._exit(0)
"""


@pytest.mark.parametrize("in_worker", [False, True])
@pytest.mark.parametrize("descriptor", [1, 2])
def test_native_code_that_prints_to_a_pipe_without_a_reader_does_not_block(
    descriptor, in_worker, tmp_path
):
    script = tmp_path / "complains.py"
    # 3,000 lines are more than the 64 kB that a pipe holds, and nobody reads this one.
    reader, pipe = os.pipe()
    told, done = os.pipe()
    (tmp_path / "library.py").write_text(LIBRARY.format(descriptor=descriptor))
    script.write_text(COMPLAINS.format(in_worker=in_worker, done=done))
    given = {"stdout": pipe} if descriptor == 1 else {"stderr": pipe}
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, script]
    with subprocess.Popen(command, env=environment, pass_fds=[done], **given) as process:
        os.close(done)
        os.close(pipe)
        # A process that blocks is killed: the read then ends without "done".
        timer = threading.Timer(60, process.kill)
        timer.start()
        assert os.read(told, 10) == b"done"
        timer.cancel()
    os.close(told)
    os.close(reader)


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
from mkpc_kaggle.engine.workers.process import ProcessWorker

answers = threading.Semaphore(0)
worker = ProcessWorker("decoder", complain, answers.release)
worker.log = Path(sys.argv[1])
worker.start()
answers.acquire()
worker.kill()
"""


def test_output_of_native_code_in_a_worker_goes_to_a_file_of_the_run(tmp_path):
    script = tmp_path / "logs.py"
    (tmp_path / "library.py").write_text(QUIET_LIBRARY)
    script.write_text(LOGS)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, script, tmp_path / "workers.log"]
    done = subprocess.run(command, env=environment, capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")
    assert (tmp_path / "workers.log").read_bytes() == b"libpng warning, libjpeg: premature end"


PRINTS = """
import os
from mkpc_kaggle.engine.console import unblocked

with unblocked():
    os.write(2, b"libjpeg: premature end")
print("later", flush=True)
os.write(2, b", again")
"""


def test_output_of_native_code_is_printed_at_the_end(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PRINTS]
    done = subprocess.run(command, capture_output=True, check=True, env=environment)
    assert done.stderr == b"libjpeg: premature end, again"


CLOSES = """
import os, sys
from mkpc_kaggle.engine.console import drain, logger, unblocked

with unblocked():
    logger.info("\u00e9")
    sys.stdout.buffer.write(b"bytes, ")
    logger.info("text")
    drain()
    os.close(sys.stdout.fileno())
    logger.info("lost")
"""


def test_text_that_a_stream_cannot_encode_and_a_closed_file_end_nothing(tmp_path):
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "PYTHONIOENCODING": "ascii",
        "PYTHONUTF8": "0",
    }
    command = [sys.executable, "-c", CLOSES]
    done = subprocess.run(command, capture_output=True, check=True, env=environment)
    assert done.stdout == b"bytes, text\n"


def test_a_machine_without_a_place_for_temporary_files_has_no_native_text_and_no_error(tmp_path):
    # As in a container in which only the output can be written
    code = """
import os, tempfile
def none(*_, **__):
    raise FileNotFoundError(2, "No usable temporary directory found")
tempfile._get_default_tempdir = none
from mkpc_kaggle.engine.console import unblocked
with unblocked():
    os.write(1, b"of a library")
    print("of the program")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "of the program\n", "")


UNREAD = """
from mkpc_kaggle.engine.console import drain, leave, logger, unblocked

with unblocked():
    for number in range(20_000):
        logger.warning("pair %d of 20000 %s", number, 100 * "x")
    logger.info("all 20,000 lines")
    leave(0, seconds=0.5)
"""


def test_a_stderr_that_is_not_read_holds_back_neither_the_program_nor_stdout():
    reader, pipe = os.pipe()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", UNREAD]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=pipe, env=environment, check=False, timeout=300
    )
    os.close(pipe)
    assert (done.returncode, done.stdout) == (0, b"all 20,000 lines\n")
    with os.fdopen(reader, "rb") as unread:
        lines = unread.read().splitlines()
    # What fits into a pipe, in order and whole but for the last line.
    assert len(lines) > 100
    for number, line in enumerate(lines[:-1]):
        assert line == b"warning: pair %d of 20000 %s" % (number, 100 * b"x")


SLOW = """
import os
os.set_blocking(2, False)
from mkpc_kaggle.engine.console import drain, logger, unblocked

with unblocked():
    for number in range(900):
        logger.warning("line %d of a non-blocking pipe %s", number, 100 * "x")
    drain(60)
"""


def test_a_pipe_that_the_parent_program_made_non_blocking_loses_no_line():
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", SLOW]
    done = subprocess.run(command, capture_output=True, env=environment, check=True, timeout=300)
    lines = done.stderr.splitlines()
    assert [line.split()[2] for line in lines] == [b"%d" % number for number in range(900)]


def test_messages_have_their_level_and_go_to_the_streams_of_the_moment(capsys):
    logger.info("pairs: %d", 3)
    logger.warning("a mask fits no image")
    logger.error("no such file")
    assert capsys.readouterr() == (
        "pairs: 3\n",
        "warning: a mask fits no image\nerror: no such file\n",
    )
