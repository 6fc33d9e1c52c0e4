"""The weights manifest: complete, readable, and refused by line where it is not."""

import re

import pytest

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.registry import matcher_names, spec_of
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, manifest, parse_manifest

SHA256 = "sha256:" + "0f" * 32


def test_the_manifest_has_every_slot_of_every_matcher_with_its_licence():
    licences: dict[str, set[str]] = {}
    for file in manifest():
        licences.setdefault(file.slot, set()).add(file.licence)
    for spec in (spec_of(name, "test") for name in matcher_names()):
        for slot in filter(spec.uses, licences):
            # Nothing says under which terms DKM's indoor weights are.
            assert licences[slot] & {*spec.licences, "unclear"}, slot
        for slot in spec.slots_for(spec.options()):
            assert licences[slot] & set(spec.licences), slot


def test_a_manifest_reads_as_written():
    text = f"# head\n\na.pt 12 {SHA256} MIT one  https://x/a.pt (a copy)  # why\n  b.pt ? unverified BSD two y\n"
    files = parse_manifest(text)
    assert files == (
        WeightFile("a.pt", 12, SHA256, "MIT", "one", "https://x/a.pt (a copy)"),
        WeightFile("b.pt", -1, UNVERIFIED, "BSD", "two", "y"),
    )
    assert parse_manifest("\n".join(file.line for file in files)) == files


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("a.pt 12 unverified MIT one", "expected 6 columns, found 5"),
        ("../a.pt 12 unverified MIT one x", "'../a.pt' is not a plain file name"),
        ("a.pt 12kB unverified MIT one x", "bytes must be a number or '?', not '12kB'"),
        (f"a.pt {'9' * 5000} unverified MIT one x", "bytes must be a number or '?', not '999"),
        ("a\x1b[2J.pt 12 unverified MIT one x", r"'a\x1b[2J.pt' is not a plain file name"),
        (f"a.pt 12 {SHA256[:-1]}g MIT one x", "digest must be"),
        (f"a.pt 12 git-blob:{'a1' * 20} MIT one x", "digest must be 'sha256:'"),
    ],
)
def test_a_line_that_cannot_be_read_is_named_by_its_number(wrong, says):
    with pytest.raises(UserError, match=f"list.txt, line 3: {re.escape(says)}"):
        parse_manifest(f"# head\nok.pt 12 unverified MIT one x\n{wrong}\n", "list.txt")
