"""the weight files: which are there, are they whole, fetch them"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.cli import options
from mkpc_kaggle.cli.options import print_table
from mkpc_kaggle.errors import UserError

if TYPE_CHECKING:
    from mkpc_kaggle.weights import WeightFile, WeightStore

HELP = """\
The files that the matchers load their weights from; none comes with the package.

  list      what each matcher needs, and where it lies
  verify    compare every file found with the manifest
  locate    where is the file that a matcher would get?
  fetch     download files, on a machine with internet
  convert   a checkpoint -> safetensors, and its line for the manifest

Exit status: 0 done, 1 a file is not there, is wrong or could not be fetched, 2 bad input.
ACTION --help tells more.
"""
_FETCH = """\
Download files; an interrupted download is resumed. If no digest is published, that of the first download is kept
in DIR/weights_manifest.txt and must be met from then on. Each licence is printed first; check it."""
_VERIFY = """\
Compare every file found with the manifest: it is good (also under another name), unverified (no digest is known,
or Kaggle unpacked it into a directory) or refused, with the reason."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    parsers = {}
    for name, act, description in (
        ("list", _list, "Each slot, which is what a matcher asks for: its licence, its matchers and its files."),
        ("verify", _verify, _VERIFY),
        ("locate", _locate, "Print the path of the file that would be taken; exit status 1 if there is none."),
        ("fetch", _fetch, _FETCH),
        ("convert", _convert, "Write a checkpoint's tensors as safetensors; print the manifest's line for it."),
    ):
        parsers[name] = actions.add_parser(name, description=description)
        parsers[name].set_defaults(act=act)
    for name in ("list", "verify", "locate"):
        options.add_weights(parsers[name])
    parsers["verify"].add_argument("--manifest", type=Path, metavar="FILE", help="is every file of it there?")
    parsers["locate"].add_argument("name", metavar="NAME|SLOT", help="a file or a slot that `list` names")
    parsers["fetch"].add_argument(
        "names", nargs="*", default=["auto"], metavar="NAME|SLOT|RECIPE", help="default: what recipe auto can use"
    )
    parsers["fetch"].add_argument("--out", type=Path, required=True, metavar="DIR", help="where the files go")
    parsers["convert"].add_argument("file", type=Path, metavar="FILE")
    parsers["convert"].add_argument("--out", type=Path, required=True, metavar="X.safetensors")


def run(arguments: argparse.Namespace) -> int:
    return int(arguments.act(arguments))


def _list(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.matchers.contract import MatcherEntry, Unusable
    from mkpc_kaggle.matchers.registry import find_matcher, matcher_names
    from mkpc_kaggle.weights import WeightStore

    store = WeightStore(arguments.weights)
    matchers = {name: find_matcher(name) for name in matcher_names()}
    specs = [matcher.spec for matcher in matchers.values() if isinstance(matcher, MatcherEntry)]
    rows = [("slot", "licence", "matchers", "file")]
    for slot in dict.fromkeys(file.slot for file in store.files):
        files = store.alternatives(slot)
        search = store.search(files)
        names = " or ".join(file.name for file in files)
        where = [str(search.found.path)] if search.found else [f"missing: {names}"]
        where += [f"refused: {file.path}: {file.note}" for file in search.refused if not search.found]
        users = [spec.name for spec in specs if slot in spec.every_slot]
        rows.append((slot, files[0].licence, ", ".join(users) or "-", "; ".join(where)))
    print_table(rows)
    for matcher in matchers.values():
        if isinstance(matcher, Unusable):
            print(matcher)
    return 0


def _verify(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights import WeightStore
    from mkpc_kaggle.weights.manifest import read_manifest

    if arguments.manifest:
        return _verify_manifest(
            WeightStore(arguments.weights, read_manifest(arguments.manifest)), arguments.manifest
        )
    store = WeightStore(arguments.weights)
    files = store.verify()
    if not files:
        print(f"no weight files found (searched {store.searched})")
        return 0
    rows = [(found.file.name, str(found.state), str(found.path), found.note) for found in files]
    print_table([("file", "state", "path", "note"), *rows])
    refused = sum(not found.usable for found in files)
    print(f"{len(files)} files, {refused} refused")
    return int(refused > 0)


def _verify_manifest(store: "WeightStore", manifest: Path) -> int:
    rows, absent = [("file", "bytes", "state", "note")], 0
    for file in store.files:
        search = store.search([file])
        absent += search.found is None
        for found in (search.found,) if search.found else search.refused:
            where = "" if found.path.parent == manifest.parent else f"{found.path} "
            rows.append((file.name, str(file.size), str(found.state), where + found.note))
        if not search.found and not search.refused:
            rows.append((file.name, str(file.size), "missing", f"searched {store.searched}"))
    if store.files:
        print_table(rows)
    print(f"{len(store.files)} files in {manifest}, {absent} of them not found or wrong")
    return int(absent > 0)


def _locate(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights import WeightStore

    store = WeightStore(arguments.weights)
    status = 0
    for search in (store.search(lines) for lines in files_of(arguments.name, store)):
        for refused in search.refused:
            print(f"refused: {refused.path}: {refused.note}", file=sys.stderr)
        if search.found:
            print(search.found.path)
        else:
            print(f"{arguments.name}: not found (searched {store.searched})", file=sys.stderr)
            status = 1
    return status


def _fetch(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights import WeightStore
    from mkpc_kaggle.weights.fetch import FetchOutcome, choose, fetch
    from mkpc_kaggle.weights.manifest import UNVERIFIED, pin

    store = WeightStore([arguments.out] if arguments.out.is_dir() else [])
    wanted = [lines for name in arguments.names for lines in files_of(name, store)]
    outcomes = []
    for file in dict.fromkeys(choose(lines, arguments.out) for lines in wanted):
        print(f"{file.name}: licence {file.licence}, from {file.source}", flush=True)
        fetched = fetch(file, arguments.out)
        print(f"{file.name}: {fetched.outcome}{fetched.note and ': '}{fetched.note}")
        if fetched.outcome is FetchOutcome.FETCHED and file.digest == UNVERIFIED:
            pin(file, fetched.path)
        outcomes.append(fetched.outcome)
    return 1 if {FetchOutcome.FAILED, FetchOutcome.BY_HAND} & set(outcomes) else 0


def _convert(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights.convert import convert

    print(convert(arguments.file, arguments.out).line)
    return 0


def files_of(name: str, store: "WeightStore") -> "list[list[WeightFile]]":
    """The files that the name of a file, a slot or a recipe stands for: a list of alternatives for each slot.

    Raises :class:`UserError` with the known names for an unknown name.
    """
    from mkpc_kaggle.pipeline.availability import slots_of
    from mkpc_kaggle.recipe import load_recipe, recipe_names

    if named := [file for file in store.files if file.name == name]:
        return [named]
    slots = list(dict.fromkeys(file.slot for file in store.files))
    if name in slots:
        return [store.alternatives(name)]
    if name in recipe_names() or name.endswith(".toml"):
        return [store.alternatives(slot) for slot in slots_of(load_recipe(name))]
    raise UserError(
        f"{name!r} is neither a file of the manifest (python -m mkpc_kaggle weights list names them), nor a slot "
        f"({', '.join(slots)}), nor a recipe ({', '.join(recipe_names())})"
    )
