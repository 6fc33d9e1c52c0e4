"""the weight files: which are there, are they whole, fetch them"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.cli import options
from mkpc_kaggle.cli.tables import print_table
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
_LIST = """\
A line for each slot of the manifest, which is what a matcher asks for: the licence of its weights, the matchers
that use it, and the file, or the names of the files that would do. Matchers that cannot be imported come last."""
_VERIFY = """\
Compare every file found with the manifest: it is good (also under another name), unverified (the manifest has no
digest for it, or Kaggle unpacked it into a directory) or refused, with the reason."""
_LOCATE = "Print the path of the file that would be taken; exit status 1 if there is none."
_FETCH = """\
Download files. A file gets its name when its digest is right; an interrupted download is resumed. If no digest is
published, a download is begun anew, and its digest is kept in DIR/weights_manifest.txt: the file must have it from
then on. Each licence is printed first; check it."""
_CONVERT = "Write a checkpoint's tensors as safetensors with the same names; print the manifest's line for it."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    searching = argparse.ArgumentParser(add_help=False)
    options.add_weights(searching)
    actions.add_parser("list", parents=[searching], description=_LIST).set_defaults(act=_list)
    verify = actions.add_parser("verify", parents=[searching], description=_VERIFY)
    verify.add_argument("--manifest", type=Path, metavar="FILE", help="is every file of this manifest there?")
    verify.set_defaults(act=_verify)

    locate = actions.add_parser("locate", parents=[searching], description=_LOCATE)
    locate.add_argument("name", metavar="NAME|SLOT", help="a file or a slot that `list` names")
    locate.set_defaults(act=_locate)

    fetch = actions.add_parser("fetch", description=_FETCH)
    fetch.add_argument(
        "names", nargs="*", default=["auto"], metavar="NAME|SLOT|RECIPE", help="default: what recipe auto can use"
    )
    fetch.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the files go")
    fetch.set_defaults(act=_fetch)

    convert = actions.add_parser("convert", description=_CONVERT)
    convert.add_argument("file", type=Path, metavar="FILE")
    convert.add_argument("--out", type=Path, required=True, metavar="X.safetensors")
    convert.set_defaults(act=_convert)


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

    if arguments.manifest:
        return _verify_manifest(arguments)
    store = WeightStore(arguments.weights)
    found = store.verify()
    if not found:
        print(f"no weight files found (searched {store.searched})")
        return 0
    rows = [(file.file.name, str(file.state), str(file.path), file.note) for file in found]
    print_table([("file", "state", "path", "note"), *rows])
    refused = sum(not file.usable for file in found)
    print(f"{len(found)} files, {refused} refused")
    return 1 if refused else 0


def _verify_manifest(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights import WeightStore
    from mkpc_kaggle.weights.manifest import read_manifest

    store = WeightStore(arguments.weights, read_manifest(arguments.manifest))
    rows, absent = [("file", "bytes", "state", "note")], 0
    for file in store.files:
        search = store.search([file])
        for found in (search.found,) if search.found else search.refused:
            beside = found.path == arguments.manifest.parent / file.name
            note = found.note if beside else f"{found.path} {found.note}"
            rows.append((file.name, str(file.size), str(found.state), note))
        if not search.found and not search.refused:
            rows.append((file.name, str(file.size), "missing", f"searched {store.searched}"))
        absent += search.found is None
    if store.files:
        print_table(rows)
    print(f"{len(store.files)} files in {arguments.manifest}, {absent} of them not found or wrong")
    return 1 if absent else 0


def _locate(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights import WeightStore

    store = WeightStore(arguments.weights)
    searches = [store.search(lines) for lines in files_of(arguments.name, store)]
    for search in searches:
        for refused in search.refused:
            print(f"refused: {refused.path}: {refused.note}", file=sys.stderr)
        if search.found:
            print(search.found.path)
        else:
            print(f"{arguments.name}: not found (searched {store.searched})", file=sys.stderr)
    return 0 if all(search.found for search in searches) else 1


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

    options.require_apart({"--out": arguments.out}, None, [arguments.file])
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
