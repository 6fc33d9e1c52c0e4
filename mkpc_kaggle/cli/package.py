"""the folders that you upload to Kaggle: a dataset and a notebook"""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.cli import options
from mkpc_kaggle.cli.tables import print_table
from mkpc_kaggle.package.metadata import LATEST
from mkpc_kaggle.package.wheels import PYTHONS

if TYPE_CHECKING:
    from mkpc_kaggle.package import Item

HELP = """\
Write DIR/dataset (our wheel, the wheels that Kaggle's image may lack, weights with their licences) and DIR/kernel
(the submission notebook), each with the metadata that the `kaggle` command reads. It runs in a checkout, on a
machine with internet or with the wheels in a directory (--wheels). Run again, it keeps what is there already.

Torch checkpoints are converted to safetensors, since Kaggle unpacks uploaded archives, which these are.
Weights whose licences do not allow redistribution are left out, unless --private is given.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the two folders go")
    parser.add_argument("--owner", required=True, metavar="NAME", help="your user name on Kaggle")
    options.add_weights(parser)
    parser.add_argument(
        "--python",
        default=",".join(PYTHONS),
        metavar="VERSIONS",
        help="the Python versions that Kaggle's image may have (default: %(default)s)",
    )
    parser.add_argument("--wheels", type=Path, metavar="DIR", help="take wheels from there and use no network")
    parser.add_argument(
        "--private",
        action="store_true",
        help="include weights that must not be redistributed: the dataset must stay private then",
    )
    parser.add_argument(
        "--image",
        default=LATEST,
        metavar="latest|original|NAME@sha256:DIGEST",
        help="Kaggle's latest image (the default), for good that of the kernel's first version, or just this one "
        "(`kaggle kernels pull NAME/mkpc-submission -m` tells which a version had, as docker_image)",
    )


def run(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.package import Request, make_package

    pythons = tuple(version.strip() for version in arguments.python.split(","))
    weights = tuple(arguments.weights)
    out: Path = arguments.out
    wheels, private, image = arguments.wheels, arguments.private, arguments.image
    package = make_package(Request(out, arguments.owner, weights, pythons, wheels, private, image))
    print(f"{out / 'dataset'}")
    _print_files(package.dataset)
    print(f"\n{out / 'kernel'}")
    _print_files(package.kernel)
    if package.restricted:
        names = ", ".join(f"{item.name} ({item.licence})" for item in package.restricted)
        print(f"\n{_PRIVATE if arguments.private else _LEFT_OUT}: {names}")
    print(_NEXT.format(out=out))
    return 0


_LEFT_OUT = """\
Left out, because their licences do not clearly allow redistribution (--private includes them)"""
_PRIVATE = """\
In this dataset, though their licences do not clearly allow redistribution. Keep the dataset private on Kaggle,
do not share it, and check what the licences say of competitions. These are"""
_NEXT = """
Next, with the `kaggle` command (README, On Kaggle):
  kaggle datasets create -p {out}/dataset
  kaggle kernels push -p {out}/kernel"""


def _print_files(items: "Iterable[Item]") -> None:
    rows = [(item.name, str(item.source.stat().st_size), item.licence or "-", item.note) for item in items]
    total = sum(int(size) for _, size, _, _ in rows)
    print_table([("file", "bytes", "licence", ""), *rows, (f"{len(rows)} files", str(total), "", "")])
