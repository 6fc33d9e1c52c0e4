"""A word has one meaning in the package."""

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "mkpc_kaggle"
# Each file is one network, whose constants have the names of its paper.
NETWORKS = PACKAGE / "matchers" / "networks"


def names_in(tree: ast.Module) -> tuple[set[str], set[str]]:
    """The classes and type aliases of a module, and its functions and constants."""
    kinds, others = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            kinds.add(node.name)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            others.add(node.name)
        targets = (
            node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        )
        for target in targets:
            if isinstance(target, ast.Name) and not is_type_variable(node):
                # A type alias is in capitals like a class.
                is_kind = target.id[0].isupper() and not target.id.isupper()
                (kinds if is_kind else others).add(target.id)
    return kinds, others


def is_type_variable(node: ast.stmt) -> bool:
    call = getattr(node, "value", None)
    return isinstance(call, ast.Call) and getattr(call.func, "id", "") in (
        "TypeVar",
        "ParamSpec",
    )


def modules() -> dict[Path, ast.Module]:
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 150
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}


def test_no_class_and_no_type_alias_has_the_name_of_another():
    defined = defaultdict(set)
    for path, tree in modules().items():
        for name in names_in(tree)[0]:
            if not name.startswith("__"):
                defined[name].add(str(path.relative_to(PACKAGE)))
    assert {name: files for name, files in defined.items() if len(files) > 1} == {}


def test_no_function_and_no_constant_that_is_imported_elsewhere_is_defined_twice():
    trees = {path: tree for path, tree in modules().items() if NETWORKS not in path.parents}
    imported = set()
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(
                "mkpc_kaggle"
            ):
                imported |= {name.name for name in node.names}
    defined = defaultdict(set)
    for path, tree in trees.items():
        for name in names_in(tree)[1] & imported:
            defined[name].add(str(path.relative_to(PACKAGE)))
    assert {name: files for name, files in defined.items() if len(files) > 1} == {}
