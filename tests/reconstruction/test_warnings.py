"""Warnings of ``reconstruct``: each of them is seen to speak in a test."""

import ast
from pathlib import Path

from mkpc_kaggle.reconstruction import choice

ROOT = Path(__file__).resolve().parents[2]


def warnings_of(module: Path) -> list[str]:
    """Return the longest fixed part of each text that a module logs as a warning."""
    found = []
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        if node.func.attr != "warning":
            continue
        parts = [
            each.value
            for each in ast.walk(node)
            if isinstance(each, ast.Constant) and isinstance(each.value, str)
        ]
        # A text from elsewhere is a variable here, and is tested where it is made.
        if parts:
            found.append(max(parts, key=len).strip())
    return found


def is_expected(text: str, tests: str) -> bool:
    """Return whether three words of a text in a row occur in the tests."""
    words = text.split()
    return any(" ".join(words[at : at + 3]) in tests for at in range(max(1, len(words) - 2)))


def test_each_warning_is_expected_by_a_test():
    """A warning that cannot speak is noticed by nobody."""
    texts = [
        text
        for module in sorted((ROOT / "mkpc_kaggle" / "reconstruction").glob("*.py"))
        for text in warnings_of(module)
    ]
    tests = "\n".join(path.read_text("utf-8") for path in sorted((ROOT / "tests").rglob("*.py")))
    assert len(texts) >= 4
    assert [text for text in texts if not is_expected(text, tests)] == []


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
