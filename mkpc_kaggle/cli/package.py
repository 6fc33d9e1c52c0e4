"""The command ``package``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.package import Request, make_package
from mkpc_kaggle.package.metadata import LATEST
from mkpc_kaggle.package.wheels import PYTHONS

HELP = """\
Write DIR/dataset (our wheel, the wheels that Kaggle's image may lack, weights with their licences) and DIR/kernel
(the submission notebook), each with the metadata that the `kaggle` command reads. It runs in a checkout, on a
machine with internet or with the wheels in a directory (--wheels). Run again, it keeps what is there already.

Torch checkpoints are converted to safetensors, since Kaggle unpacks uploaded archives, which these are.
Weights whose licences do not allow redistribution are left out, unless --private is given.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="where the two folders go")
    add("--owner", required=True, metavar="NAME", help="your user name on Kaggle")
    options.add_weights(parser)
    text = "the Python versions that Kaggle's image may have (default: %(default)s)"
    add("--python", default=",".join(PYTHONS), metavar="VERSIONS", help=text)
    add("--wheels", type=Path, metavar="DIR", help="take wheels from there and use no network")
    text = "include weights that must not be redistributed: the dataset must stay private then"
    add("--private", action="store_true", help=text)
    text = """Kaggle's latest image (the default), for good that of the kernel's first version, or just this one
        (`kaggle kernels pull NAME/mkpc-submission -m` tells which a version had, as docker_image)"""
    add("--image", default=LATEST, metavar="latest|original|NAME@sha256:DIGEST", help=text)


def run(arguments: argparse.Namespace) -> int:
    out, private, image = arguments.out, arguments.private, arguments.image
    pythons = tuple(version.strip() for version in arguments.python.split(","))
    weights = tuple(arguments.weights)
    package = make_package(Request(out, arguments.owner, weights, pythons, arguments.wheels, private, image))
    for folder, items in (("dataset", package.dataset), ("kernel", package.kernel)):
        sizes = [item.source.stat().st_size for item in items]
        rows = [(i.name, str(size), i.licence or "-", i.note) for i, size in zip(items, sizes, strict=True)]
        total = f"{len(rows)} files", str(sum(sizes)), "", ""
        print(out / folder)
        options.print_table([("file", "bytes", "licence", ""), *rows, total])
        print()
    if package.restricted:
        names = ", ".join(f"{item.name} ({item.licence})" for item in package.restricted)
        print(f"{_PRIVATE if private else _LEFT_OUT}: {names}\n")
    print(_NEXT.format(out=out))
    return 0


_LEFT_OUT = "Left out, because their licences do not clearly allow redistribution (--private includes them)"
_PRIVATE = """\
In this dataset, though their licences do not clearly allow redistribution. Keep the dataset private on Kaggle,
do not share it, and check what the licences say of competitions. These are"""
_NEXT = """\
Next, with the `kaggle` command (README.md; details in docs/kaggle.md):
  kaggle datasets create -p {out}/dataset
  kaggle kernels push -p {out}/kernel"""
