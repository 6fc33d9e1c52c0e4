"""The command ``package``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.package import PYTHONS, make_package

HELP = """\
Write two folders, each with the metadata for the `kaggle` command:
  DIR/dataset  our wheel, wheels of packages that may be missing on Kaggle, weights with their licences;
  DIR/kernel   the submission notebook.

Run it in a checkout, with internet or with the wheels in a directory (--wheels).
Torch checkpoints are converted to safetensors, since Kaggle unpacks uploaded archives.
Weights whose licences do not allow redistribution are left out, unless --private is given.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="the directory for the two folders",
    )
    add("--owner", required=True, metavar="NAME", help="your user name on Kaggle")
    options.add_weights(parser)
    add(
        "--python",
        default=",".join(PYTHONS),
        metavar="VERSIONS",
        help="Python version of the wheels (default: %(default)s)",
    )
    add("--wheels", type=Path, metavar="DIR", help="take wheels from DIR, without a network")
    text = (
        "include weights that must not be redistributed; the dataset must then stay private"
    )
    add("--private", action="store_true", help=text)


def run(arguments: argparse.Namespace) -> None:
    out: Path = arguments.out
    package = make_package(
        out,
        arguments.owner,
        arguments.weights,
        pythons=[version.strip() for version in arguments.python.split(",")],
        wheels=arguments.wheels,
        private=arguments.private,
    )
    licences = {file.name: file.licence for file in package.weights}
    for folder, paths in (("dataset", package.dataset), ("kernel", package.kernel)):
        rows = [("file", "bytes", "licence")]
        for path in paths:
            rows.append((path.name, str(path.stat().st_size), licences.get(path.name, "")))
        print(out / folder)
        options.print_table(rows)
        print()
    # Also with --private: then they are in the dataset, and the user must know.
    if package.restricted:
        names = ", ".join(f"{file.name} ({file.licence})" for file in package.restricted)
        print(f"{_PRIVATE if arguments.private else _LEFT_OUT}: {names}\n")
    print(_NEXT.format(out=out))


_LEFT_OUT = "Left out, because their licences do not clearly allow redistribution (--private includes them)"
_PRIVATE = """\
Included, although their licences do not clearly allow redistribution. Keep the dataset private on Kaggle, do not
share it, and check what the licences say about competitions"""
# Kaggle creates a dataset once; each later upload is a version of it.
_NEXT = """\
Next, with the `kaggle` command (README.md; details in docs/kaggle.md):
  kaggle datasets create -p {out}/dataset, or of a dataset that exists:
  kaggle datasets version -p {out}/dataset -m "new files"
  kaggle kernels push -p {out}/kernel"""
