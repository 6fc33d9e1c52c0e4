"""Warnings and reasons of the package: each of them is seen to speak in a test."""

import ast
from collections.abc import Iterator
from pathlib import Path

from mkpc_kaggle.reconstruction import choice

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "mkpc_kaggle"
# Their functions return or yield sentences for users.
LAYERS = ("data", "reconstruction", "reporting", "scene")
CALLS = ("warning", "error", "warn", "fault")
WORDS = 3  # in a row, that a test expects
Parts = list[str]  # the fixed parts of a text


def parts_of(node: ast.AST) -> Parts:
    """Return the fixed parts of a text."""
    return [
        each.value.strip()
        for each in ast.walk(node)
        if isinstance(each, ast.Constant) and isinstance(each.value, str)
    ]


def assigned(function: ast.AST, name: str) -> Parts:
    """Return the fixed parts of all texts that a function gives a variable."""
    parts = []
    for node in ast.walk(function):
        targets = node.targets if isinstance(node, ast.Assign) else []
        targets = [node.target] if isinstance(node, ast.AugAssign) else targets
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            parts += parts_of(node.value)
    return parts


def warnings_of(module: Path) -> Iterator[Parts]:
    """Yield the parts of each warning, fault or error that a module logs."""
    for function in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in ast.walk(function):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            if node.func.attr not in CALLS or not node.args:
                continue
            text = node.args[0]
            parts = assigned(function, text.id) if isinstance(text, ast.Name) else parts_of(text)
            # A text from elsewhere is tested where it is made.
            if parts:
                yield parts


def sentences_of(module: Path) -> Iterator[Parts]:
    """Yield the parts of each sentence that a function of a module returns or yields."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Yield | ast.Return) and node.value is not None:
            parts = parts_of(node.value)
            if any(part.count(" ") >= WORDS for part in parts):
                yield parts


def is_expected(parts: Parts, tests: str) -> bool:
    """Return whether three words in a row of a text occur in the tests."""
    for part in parts:
        words = part.split()
        few = min(WORDS, max(len(part.split()) for part in parts))
        runs = (" ".join(words[at : at + few]) for at in range(len(words) - few + 1))
        if any(run in tests for run in runs):
            return True
    return False


def test_each_warning_is_expected_by_a_test():
    """A warning that cannot speak is noticed by nobody."""
    tests = "\n".join(path.read_text("utf-8") for path in sorted((ROOT / "tests").rglob("*.py")))
    texts = [parts for module in sorted(PACKAGE.rglob("*.py")) for parts in warnings_of(module)]
    assert len(texts) >= 20
    for layer in LAYERS:
        for module in sorted((PACKAGE / layer).glob("*.py")):
            texts += sentences_of(module)
    assert len(texts) >= 80
    missing = [parts for parts in texts if not is_expected(parts, tests)]
    assert missing == []


def test_images_that_could_not_be_compared_are_warned_of_and_have_no_partners(
    monkeypatch, capsys, tmp_path
):
    # The comparison failed, or the time was over.
    monkeypatch.setattr(choice, "compare_images", lambda *_: None)
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    assert choice.find_partners(None, tmp_path, files, 4) == [[], []]
    assert f"the images of {tmp_path} were not compared" in capsys.readouterr().err
    assert choice.find_overlaps(None, tmp_path, files) == [(0, 1)]
    assert "not compared; all pairs are matched" in capsys.readouterr().err
