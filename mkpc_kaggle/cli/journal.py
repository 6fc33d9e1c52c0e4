"""The command ``journal``."""

import argparse
from pathlib import Path

from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import results
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.reporting.summary import overview

HELP = """\
Show how far a run is, also while it is running. DIR is the run's work directory, NAME.work next to
the submission. In Python, mkpc_kaggle.results(DIR) has its results as DataFrames.

--prune removes the results that the last run did not use: of former recipes, settings, images and
rows. If they are asked for again, they are computed again. It prints the size that it sets free.

Exit status: 0 done, 2 the journal does not exist, or cannot be written.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("work_dir", type=Path, metavar="DIR", help="work directory of the run")
    text = "remove the results that the last run did not use"
    parser.add_argument("--prune", action="store_true", help=text)


def run(arguments: argparse.Namespace) -> None:
    found = results(arguments.work_dir)  # refuses a directory without a run
    if not arguments.prune:
        print(overview(found))
        return
    with Store.open(arguments.work_dir) as store:
        freed = store.prune(Published.of(store).keys)
    print(f"{freed / 1e6:.2f} MB are free again")
