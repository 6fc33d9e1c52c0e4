"""The pages agree with the program: messages, commands, options and Python."""

import argparse
import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from IPython.core.inputtransformer2 import TransformerManager
from sklearn.datasets import load_sample_image

from mkpc_kaggle.cli import COMMANDS, make_parser
from mkpc_kaggle.recipe import parse_recipe

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def texts_of(source: str) -> Iterator[str]:
    """The texts of a program, with {} for inserted values; adjoining texts are joined."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            parts = [
                part.value if isinstance(part, ast.Constant) else "{}" for part in node.values
            ]
            yield "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def everything_said() -> str:
    modules = sorted((ROOT / "mkpc_kaggle").rglob("*.py"))
    sources = [path.read_text(encoding="utf-8") for path in modules]
    notebook = (ROOT / "notebooks" / "submission.ipynb").read_text(encoding="utf-8")
    cells = json.loads(notebook)["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    # Cells have lines such as "!nvidia-smi", which are no Python.
    python = [TransformerManager().transform_cell(text) for text in code]
    return "\n".join(text for source in [*sources, *python] for text in texts_of(source))


def pattern_of(message: str) -> str:
    """Three dots stand for anything, F for the name of a model."""
    literal = re.escape(message).replace(r"\ ", " ").replace(r"\.\.\.", ".*")
    return re.sub(r"\bF\b", r"\\{\\}", literal)


def test_every_message_of_the_troubleshooting_page_is_one_of_the_programs():
    """They are in backticks in the first column of its table."""
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    known = []
    for row in re.findall(r"^\| (.*?) \|", page, re.M):
        known += [text for text in re.findall(r"`([^`]+)`", row) if not text.startswith("--")]
    said = everything_said()
    # A page in another form would have no messages, and nothing to compare.
    assert len(known) > 25
    assert [message for message in known if not re.search(pattern_of(message), said)] == []


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    return {text for action in parser._actions for text in action.option_strings}


def inner(parser):
    """The parsers of its commands, by name."""
    found = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found |= action.choices
    return found


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Each command of ours on a page, and the options that it is given there."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for line in re.findall(r"(?:(?<![\w/-])mkpc [a-z]|make_submission\.py )[^`\n#;]*", text):
        name = "submit" if line.startswith("make") else line.split()[1]
        yield name, re.findall(r"(?<= )--[a-z0-9-]+", line)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_name_only_commands_and_options_that_exist(page):
    known = inner(make_parser(list(COMMANDS)))
    for name, options in commands(page):
        assert name in known, name
        have = set().union(*map(options_of, [known[name], *inner(known[name]).values()]))
        assert set(options) <= have, (name, set(options) - have)


# Options of other programs that pages name: pip, kaggle, ray, COLMAP, nerfstudio.
OTHERS = {"--no-deps", "--follow", "--head"}
OTHERS |= {
    "--colmap-path",
    "--data",
    "--database",
    "--downscale-factor",
    "--image",
    "--import",
}
OTHERS |= {"--result"}
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


def all_options() -> set[str]:
    """The options of all commands that ``--help`` shows."""
    known = set()
    for parser in inner(make_parser(list(COMMANDS))).values():
        for own in (parser, *inner(parser).values()):
            shown = [action for action in own._actions if action.help != argparse.SUPPRESS]
            known |= {text for action in shown for text in action.option_strings}
    return known - {"-h", "--help"}


def test_every_option_is_in_the_pages_and_every_option_of_the_pages_exists():
    pages = {page.stem: set(OPTION.findall(page.read_text("utf-8"))) for page in PAGES}
    named = set().union(*pages.values()) - {"--help", "--version"}
    known = all_options()
    assert len(known) > 20
    assert sorted(known - named) == [], "options that no page names"
    measured = "\n".join(
        path.read_text("utf-8") for path in (ROOT / "benchmarks").rglob("*.py")
    )
    benchmarks = set(OPTION.findall(measured))
    assert sorted(named - known - benchmarks - OTHERS) == [], "options that do not exist"


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


LINKED = [*PAGES, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "benchmarks").glob("*.md"))]


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.stem)
def test_links_lead_to_files_and_headings_that_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.S)
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?:|\.\./\.\./actions", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


PYTHON = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
# Other files run the snippets of python.md, of folder.md and of vismatch.
BLOCKS = [
    block
    for page in PAGES
    if page.stem not in ("python", "folder")
    for block in PYTHON.findall(page.read_text("utf-8"))
    if "import vismatch" not in block
]


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_the_python_of_the_pages_runs(block, tmp_path, monkeypatch):
    """On two parts of a photograph."""
    photograph = load_sample_image("china.jpg")
    for name, shift in (("a.jpg", 0), ("b.jpg", 40)):
        assert cv2.imwrite(str(tmp_path / name), photograph[:, shift : shift + 560, ::-1])
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    # Examples read and write files by short names, and import the template of a matcher.
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "docs")
    names = {}
    exec(compile(block, "page", "exec"), names)
    assert names["match"].estimate.inlier_count > 50


def test_the_recipe_of_the_pages_is_a_recipe():
    page = (ROOT / "docs" / "recipes.md").read_text("utf-8")
    parse_recipe(page.split("```toml\n")[1].split("```")[0], "shown")


def test_a_folder_uses_those_above_it_and_never_those_below():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    folders = re.findall(r"^\| `(\w+)/` \|", page, re.M)
    order = [
        "errors",
        "version",
        "config",
        "progress",
        "cores",
        "signals",
        folders[0],
        "recipe",
        *folders[1:],
    ]
    package = ROOT / "mkpc_kaggle"
    found = {path.name for path in package.iterdir() if (path / "__init__.py").is_file()}
    assert found == set(folders)
    # Also imports within functions, which no import at the start would show.
    importing = re.compile(r"^\s*(?:from|import) mkpc_kaggle\b\.?(\w*)", re.M)
    for path in package.glob("*/**/*.py"):
        layer = order.index(path.relative_to(package).parts[0])
        used = importing.findall(path.read_text(encoding="utf-8"))
        assert [name for name in used if name not in order[: layer + 1]] == [], path


def test_no_error_of_any_type_is_dropped():
    # Such a block turns a limit of a library into "no information".
    dropped = re.compile(r"suppress\((Base)?Exception\b|except( (Base)?Exception)?:\s+pass\b")
    files = sorted((ROOT / "mkpc_kaggle").rglob("*.py"))
    assert [
        str(path) for path in files if dropped.search(path.read_text(encoding="utf-8"))
    ] == []
