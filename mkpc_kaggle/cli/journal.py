"""The command ``journal``."""

import argparse
from functools import partial
from pathlib import Path

from mkpc_kaggle.data.competition import read_test_side, test_side
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.streams import unblocked
from mkpc_kaggle.reporting.report import write_report
from mkpc_kaggle.reporting.run_log import read_log, write_csv
from mkpc_kaggle.reporting.summary import overview

HELP = """\
Read the journal of a run, running or ended, and show what it did. DIR is the run's work directory, NAME.work
beside the submission. Without options: one screen.

--csv writes long tables that pandas.read_csv takes as they are, with `pair`, the row of the test set, in common:
  pairs.csv    ids, image names, failure, source of F (pair, scene, fallback), matches, inliers, seconds by part;
               of the F of the pair's own matches: support (how many times as many matches agree with it as by
               chance), overlaps (whether the images show the same thing), candidates, cost of the winner and of
               MAGSAC's own F, the focal lengths found; F (f11 ... f33)
  units.csv    for each unit on each pair: matches, inliers, seconds, failure
  regions.csv  for each image (0 or 1) of each pair: the critical region's box and the reason for it
  events.csv   what happened when: starts, plans, jobs that ended, faults, ends

Exit status: 0 done, 2 there is no such journal, or a file cannot be written.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(printing=partial(unblocked, "stderr"))  # on which decoders complain
    parser.add_argument("work_dir", type=Path, metavar="DIR")
    parser.add_argument("--csv", type=Path, metavar="OUT", help="the directory for the tables")
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="a page to look at, pictures inside")
    parser.add_argument("--test-dir", type=Path, metavar="DIR", help="where the images are that the report draws")


def run(arguments: argparse.Namespace) -> int:
    require_apart(
        {"--report": arguments.report},
        test_side(arguments.test_dir) if arguments.test_dir else [],
        arguments.work_dir,
    )
    log = read_log(arguments.work_dir)
    written = write_csv(log, arguments.csv) if arguments.csv else []
    if arguments.report:
        pairs = read_test_side(arguments.test_dir) if arguments.test_dir else ()
        write_report(log, arguments.report, pairs)
        written.append(arguments.report)
    print("\n".join(map(str, written)) or overview(log))
    return 0
