"""the weight files: which are there, are they whole, fetch them"""

import argparse
import sys
from pathlib import Path

from mkpc_kaggle.cli import options
from mkpc_kaggle.cli.tables import print_table

HELP = """\
The files that the matchers load their weights from; none comes with the package.

  list      every file: size, licence, who uses it, where it lies; what the missing ones would enable
  verify    compare every file found with the manifest
  locate    where is the file that a matcher would get?
  fetch     download files, on a machine with internet
  convert   a checkpoint -> safetensors, and its line for the manifest

Exit status: 0 done, 1 a file is not there, is wrong or could not be fetched, 2 bad input.
ACTION --help tells more.
"""
_LIST = "Every file of the manifest, who uses it and where it lies; and what the missing ones would enable."
_VERIFY = """\
Compare every file found with the manifest: truncated ones, other files under the right name, files under another
name (which do as well), and files that the manifest has no digest for."""
_LOCATE = "Print the path of the file that would be taken; exit status 1 where there is none."
_FETCH = """\
Download files: interrupted downloads are resumed, and a file gets its name when its digest is right. Where none is
published, the first download's is kept in DIR/weights_manifest.txt, and the file must have it from then on. Each
licence is printed first; check it."""
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
    from mkpc_kaggle.pipeline.uses import matchers_with, recipes_with, unusable
    from mkpc_kaggle.weights import WeightStore

    store = WeightStore(arguments.weights)
    rows = [("file", "bytes", "licence", "slot", "matchers", "where")]
    for file in store.files:
        search = store.search([file])
        where = [str(search.found.path)] if search.found else [f"{one.path}: {one.note}" for one in search.refused]
        size = "?" if file.size < 0 else str(file.size)
        matchers = ", ".join(matchers_with(file.slot)) or "-"
        rows.append((file.name, size, file.licence, file.slot, matchers, "; ".join(where) or "missing"))
    print_table(rows)
    for slot in dict.fromkeys(file.slot for file in store.files):
        alternatives = store.alternatives(slot)
        if store.search(alternatives).found is None:
            uses = [f"matcher {name}" for name in matchers_with(slot)]
            uses += [f"recipe {name}" for name in recipes_with(slot)]
            names = " or ".join(file.name for file in alternatives)
            print(f"missing: {slot} ({names}), for {', '.join(uses) or 'no matcher of this version'}")
    for one in unusable():
        print(one)
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
    rows = [(one.file.name, str(one.state), str(one.path), one.note) for one in found]
    print_table([("file", "state", "path", "note"), *rows])
    wrong = sum(not one.state.usable for one in found)
    print(f"{len(found)} files, {wrong} wrong")
    return 1 if wrong else 0


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
    from mkpc_kaggle.pipeline.uses import files_of
    from mkpc_kaggle.weights import WeightStore

    store = WeightStore(arguments.weights)
    searches = [store.search(lines) for lines in files_of(arguments.name, store)]
    for search in searches:
        for one in search.refused:
            print(f"refused: {one.path}: {one.note}", file=sys.stderr)
        if search.found:
            print(search.found.path)
        else:
            print(f"{arguments.name}: not found (searched {store.searched})", file=sys.stderr)
    return 0 if all(search.found for search in searches) else 1


def _fetch(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.pipeline.uses import files_of
    from mkpc_kaggle.weights import WeightStore
    from mkpc_kaggle.weights.fetch import Outcome, choose, fetch
    from mkpc_kaggle.weights.manifest import UNVERIFIED, pin

    store = WeightStore([arguments.out] if arguments.out.is_dir() else [])
    wanted = [lines for name in arguments.names for lines in files_of(name, store)]
    outcomes = []
    for file in dict.fromkeys(choose(lines, arguments.out) for lines in wanted):
        print(f"{file.name}: licence {file.licence}, from {file.source}", flush=True)
        fetched = fetch(file, arguments.out)
        print(f"{file.name}: {fetched.outcome}{fetched.note and ': '}{fetched.note}")
        if fetched.outcome is Outcome.FETCHED and file.digest == UNVERIFIED:
            pin(file, fetched.path)
        outcomes.append(fetched.outcome)
    return 1 if {Outcome.FAILED, Outcome.BY_HAND} & set(outcomes) else 0


def _convert(arguments: argparse.Namespace) -> int:
    from mkpc_kaggle.weights.convert import convert

    print(convert(arguments.file, arguments.out).line)
    return 0
