"""The command ``submit``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.data.competition import missing_line, read_test_side, test_side
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.session import first_version, submit
from mkpc_kaggle.errors import plural
from mkpc_kaggle.reporting.summary import left_out_line, summary, trouble
from mkpc_kaggle.setup.console import logger
from mkpc_kaggle.signals import interruptible

HELP = """\
Match every pair of test.csv and write one row per pair, its fundamental matrix.

submission.csv is complete from the start: pending pairs have a fallback matrix, and later versions have more F.
If the run is killed, the same command resumes it from its journal in the work directory. Ctrl-C and SIGTERM end
the run early with a valid file.

Exit status: 0 done, or the time limit was reached; 1 the run failed (no worker remained, or errors left most pairs
without an F), or the last version of the file, or of the journal, could not be written; an earlier version is
complete; 2 bad input; 130 or 143 ended by a signal; the file is complete.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--test-dir",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory with test.csv and test_images/",
    )
    add(
        "--output",
        type=Path,
        default=Path("submission.csv"),
        help="file to write (default: submission.csv)",
    )
    options.add_matching(parser)
    text = """reconstruct the pairs of a batch together and take F from the cameras (default: the recipe's choice;
        imc2022 does not). A pair's F then also depends on other pairs: read your competition's rules,
        and compare published stereo scores with --no-scenes only"""
    add("--scenes", dest="reconstruct", action=argparse.BooleanOptionalAction, help=text)
    options.add_run(parser, time_limit="8h45m")
    add(
        "--work-dir",
        type=Path,
        metavar="DIR",
        help="for the journal; default: NAME.work next to the output",
    )
    add("--fresh", action="store_true", help="delete the journal of an earlier run")
    text = "write no page; otherwise it is NAME.html next to the output"
    add("--no-report", action="store_true", help=text)


def run(arguments: argparse.Namespace) -> int:
    output: Path = arguments.output
    work_dir: Path = arguments.work_dir or output.parent / f"{output.stem}.work"
    page = None if arguments.no_report else output.parent / f"{output.stem}.html"
    files = {"--output": output, "the report": page}
    inputs = [*test_side(arguments.test_dir), *options.recipe_files(arguments.recipe)]
    require_apart(files, inputs, work_dir, arguments.weights)
    with interruptible() as interrupt:
        pairs = read_test_side(arguments.test_dir)
        # The first version precedes the watchdog: a run that starts after its limit must leave a
        # complete file.
        first_version(pairs, output, work_dir)
        with options.watched_session(arguments, work_dir, interrupt) as session:
            assembly = options.assembly_of(arguments, interrupt, arguments.recipe)
            about = f"{plural(len(pairs), 'pair')}, recipe {assembly.recipe.name}, {assembly.placement}"
            lines = [
                f"{about}, journal in {work_dir}",
                left_out_line(assembly.recipe, assembly.left_out),
                missing_line(pairs),
            ]
            logger.info("\n".join(filter(None, lines)))
            _, images = test_side(arguments.test_dir)
            report = submit(pairs, assembly, session, output, str(images))
            unwritten = report.about.unwritten
            failed = unwritten or report.about.unsaved or trouble(report)
            session.status = int(bool(failed))
            reason = f" is not the last version: {unwritten}" if unwritten else ""
            # A file that could not be replaced is an earlier version; it is complete, too.
            # Before the report: drawing may exceed the time limit.
            logger.info(f"{summary(report)}\nsubmission: {output}{reason}")
            return options.finish(session, page, pairs)
