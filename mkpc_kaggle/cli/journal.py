"""The command ``journal``."""

import argparse
from pathlib import Path

from mkpc_kaggle.data.competition import read_test_side, test_side
from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.reporting.report import write_report
from mkpc_kaggle.reporting.run_log import read_log, write_csv
from mkpc_kaggle.reporting.summary import overview
from mkpc_kaggle.reporting.verdict import write_summary

HELP = """\
Show the journal of a run, also while it is running. DIR is the run's work directory, NAME.work next to the
submission. Without options, print an overview of one screen.

--csv writes tables for pandas.read_csv. All have the column `pair`, the id of the pair:
  pairs.csv    images (paths below the directory of the run's images), failure, source of F (scene; pair;
               earlier, until this run has its own; fallback), matches, inliers, seconds by part; f11 ... f33, the
               matrix of the column model: F, or E for pairs with known intrinsics. For the F of the pair's own
               matches: support (ratio of inliers to inliers by chance), overlaps (whether the images overlap),
               number of candidates; cost of the result and of MAGSAC's own F, focal lengths. choice: why the F is
               the scene's, or not; units: the number of units that ran or failed; error: why the pair has no F,
               unless it has few matches
  units.csv    per unit and pair: matches, inliers, seconds, failure
  regions.csv  per image (0 or 1) and pair: the critical region's box and the reason for it
In Python, mkpc_kaggle.results(DIR) returns the first two and the cameras as DataFrames with the same columns.

--prune removes the results that the last run did not use: of former recipes, settings, images and rows. If
they are asked for again, they are computed again. It prints the size that it sets free. Tables and the page are
written first.

Exit status: 0 done, 2 the journal does not exist, or a file cannot be written.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("work_dir", type=Path, metavar="DIR", help="work directory of the run")
    parser.add_argument("--csv", type=Path, metavar="OUT", help="write tables to this directory")
    parser.add_argument(
        "--report", type=Path, metavar="FILE.html", help="write a page with pictures"
    )
    text = "remove the results that the last run did not use"
    parser.add_argument("--prune", action="store_true", help=text)
    parser.add_argument(
        "--test-dir", type=Path, metavar="DIR", help="the images that the report draws"
    )


def run(arguments: argparse.Namespace) -> None:
    # The page must not be written over the test side, nor over the journal itself.
    inputs = test_side(arguments.test_dir) if arguments.test_dir else []
    require_apart({"--report": arguments.report}, inputs, arguments.work_dir)
    log = read_log(arguments.work_dir)  # refuses a directory without a run
    written = [*map(str, write_csv(arguments.work_dir, arguments.csv))] if arguments.csv else []
    if arguments.report:
        # Without the test side, the page has no pictures.
        pairs = read_test_side(arguments.test_dir) if arguments.test_dir else ()
        write_report(log, arguments.report, pairs)
        pages = [arguments.report, write_summary(log, arguments.report)]
        written += [str(page) for page in pages if page]
    # Last: tables and pages show the same results before and after.
    if arguments.prune:
        with Store.open(arguments.work_dir) as store:
            freed = store.prune(Published.of(store).keys)
        written.append(f"{freed / 1e6:.2f} MB are free again")
    # The files that were written, else the overview.
    print("\n".join(written) or overview(log))
