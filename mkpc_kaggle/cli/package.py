"""The command ``package``."""

import argparse
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.errors import plural
from mkpc_kaggle.package.metadata import DATASET_METADATA, LATEST
from mkpc_kaggle.package.package import PackageRequest, make_package
from mkpc_kaggle.package.wheels import PYTHONS

HELP = """\
Write two folders, each with the metadata for the `kaggle` command:
  DIR/dataset  our wheel, wheels of packages that may be missing on Kaggle, weights with their licences;
  DIR/kernel   the submission notebook.

Run it in a checkout, with internet or with the wheels in a directory (--wheels). A second run keeps valid files.
Torch checkpoints are converted to safetensors, since Kaggle unpacks uploaded archives.
Weights whose licences do not allow redistribution are left out, unless --private is given.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="the directory for the two folders")
    add("--owner", required=True, metavar="NAME", help="your user name on Kaggle")
    options.add_weights(parser)
    add(
        "--python",
        default=",".join(PYTHONS),
        metavar="VERSIONS",
        help="Python version of the wheels (default: %(default)s)",
    )
    add("--wheels", type=Path, metavar="DIR", help="take wheels from DIR, without a network")
    text = "include weights that must not be redistributed; the dataset must then stay private"
    add("--private", action="store_true", help=text)
    text = "attach ALIKED and LightGlue from Kaggle Models to the notebook: nothing to download or upload"
    add("--models", action="store_true", help=text)
    text = """Kaggle's latest image (the default), the image of the kernel's first version, or this image
        (`kaggle kernels pull NAME/mkpc-submission -m` prints the image of a version as docker_image)"""
    add("--image", default=LATEST, metavar="latest|original|NAME@sha256:DIGEST", help=text)


def run(arguments: argparse.Namespace) -> None:
    out: Path = arguments.out
    request = PackageRequest(
        out,
        arguments.owner,
        weights=tuple(arguments.weights),
        pythons=tuple(version.strip() for version in arguments.python.split(",")),
        wheels=arguments.wheels,
        private=arguments.private,
        image=arguments.image,
        models=arguments.models,
    )
    # Kaggle creates a dataset once; each later upload is a version of it.
    is_packaged = (out / "dataset" / DATASET_METADATA).is_file()
    package = make_package(request)
    for folder, items in (("dataset", package.dataset), ("kernel", package.kernel)):
        rows = [("file", "bytes", "licence", "")]
        total = 0
        for item in items:
            size = item.source.stat().st_size
            total += size
            rows.append((item.name, str(size), item.licence or "-", item.note))
        rows.append((plural(len(items), "file"), str(total), "", ""))
        print(out / folder)
        options.print_table(rows)
        print()
    # Also with --private: then they are in the dataset, and the user must know.
    if package.restricted:
        names = ", ".join(f"{item.name} ({item.licence})" for item in package.restricted)
        print(f"{_PRIVATE if arguments.private else _LEFT_OUT}: {names}\n")
    print((_NEXT_VERSION if is_packaged else _NEXT).format(out=out))


_LEFT_OUT = (
    "Left out, because their licences do not clearly allow redistribution (--private includes them)"
)
_PRIVATE = """\
Included, although their licences do not clearly allow redistribution. Keep the dataset private on Kaggle, do not
share it, and check what the licences say about competitions"""
_NEXT = """\
Next, with the `kaggle` command (README.md; details in docs/kaggle.md):
  kaggle datasets create -p {out}/dataset
  kaggle kernels push -p {out}/kernel"""
_NEXT_VERSION = """\
Next, with the `kaggle` command. The folder was packaged before, so the dataset on Kaggle gets a new version. If it
is not on Kaggle yet, the first command is `kaggle datasets create -p {out}/dataset`:
  kaggle datasets version -p {out}/dataset -m "new files"
  kaggle kernels push -p {out}/kernel"""
