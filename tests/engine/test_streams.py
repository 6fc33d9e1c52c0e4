"""Standard streams that are not read, or that a library uses in its own way, cost neither time nor
a job.
"""

import os
import subprocess
import sys
from pathlib import Path

from mkpc_kaggle.setup.console import (
    LOG_NAME,
    Progress,
    logged,
    logger,
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
    assert (
        tmp_path / "workers.log"
    ).read_bytes() == b"libpng warning, libjpeg: premature end"


UNREAD = """
from mkpc_kaggle.setup.console import Progress, leave, logger, queued

with queued():
    progress = Progress()
    for number in range(4_000):
        progress.count("sweep", number % 2, 2, "unit")
        logger.warning("pair %d of 4000 %s", number, 100 * "x")
    print("done", flush=True)
    leave(0, seconds=0.5)
"""


def test_a_stderr_that_is_not_read_costs_lines_and_not_the_run():
    reader, pipe = os.pipe()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", UNREAD]
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=pipe,
        env=environment,
        check=False,
        timeout=300,
    )
    os.close(pipe)
    os.close(reader)
    assert (done.returncode, done.stdout) == (0, b"done\n")


def test_a_file_gets_a_line_when_a_count_begins_and_at_its_end(capsys):
    progress = Progress()
    for done in range(40, 101):  # resumed pairs took no time of this run
        progress.count("sweep", done, 200, "unit")
    progress.note("batch one: 4 of 4 images with a camera")
    progress.count("deepen", 200, 200, "unit")
    progress.count("estimate", 1, 2, "pair")
    progress.close()
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition("%")[0] for line in lines] == [
        "sweep:  20",
        "batch one: 4 of 4 images with a camera",
        "deepen: 100",
        "estimate:  50",
        "estimate:  50",
    ]


def test_a_log_file_has_all_messages_and_one_that_cannot_be_written_costs_nothing(
    tmp_path, capsys
):
    for path in (tmp_path / LOG_NAME, tmp_path / "none" / LOG_NAME):
        with logged(path):
            logger.debug("sweep")
            logger.warning("a device failed")
    lines = (tmp_path / LOG_NAME).read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in lines] == [
        "DEBUG sweep",
        "WARNING a device failed",
    ]
    assert "sweep" not in capsys.readouterr().err
