"""The pages agree with the program: messages, commands, options and Python."""

import argparse
import ast
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from IPython.core.inputtransformer2 import TransformerManager
from sklearn.datasets import load_sample_image

from mkpc_kaggle.cli import COMMANDS, make_parser
from mkpc_kaggle.engine.plan import schedule, time_limits
from mkpc_kaggle.engine.plan.budget import (
    MARGIN,
    MAX_SILENCE_S,
    MIN_MARGIN,
    MIN_SILENCE_S,
    SCENE_MATCH_S,
    SCENE_START_S,
    SILENCE_SHARE,
)
from mkpc_kaggle.geometry import critical_region, crop_need, robust
from mkpc_kaggle.geometry.critical_region import MkpcConfig
from mkpc_kaggle.geometry.focal_prior import ESSENTIAL_THRESHOLD_PX
from mkpc_kaggle.geometry.overlap import AGREEMENT_PX
from mkpc_kaggle.geometry.planarity import TRANSFER_PX
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import SceneConfig, load_recipe
from mkpc_kaggle.reconstruction.choice import TRIAL_SHARE
from mkpc_kaggle.reconstruction.run import MAGSAC_ITERATIONS
from mkpc_kaggle.scene import assumptions, choose, densify, shared_intrinsics
from mkpc_kaggle.scene.mapper import MIN_OBSERVATIONS
from mkpc_kaggle.scene.models import MIN_DISPLACEMENT
from mkpc_kaggle.scene.motion import MAX_TRANSFER_PX

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def texts_of(source: str) -> Iterator[str]:
    """The texts of a program, with {} for inserted values; adjoining texts are joined."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
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


# Options of other programs that pages name: pip, kaggle, ray, accelerators of Kaggle, COLMAP, nerfstudio.
OTHERS = {"--no-deps", "--follow", "--head", "--accelerator"}
OTHERS |= {"--colmap-path", "--data", "--database", "--downscale-factor", "--import", "--result"}
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
    assert len(known) > 45
    assert sorted(known - named) == [], "options that no page names"
    measured = "\n".join(path.read_text("utf-8") for path in (ROOT / "benchmarks").rglob("*.py"))
    benchmarks = set(OPTION.findall(measured))
    assert sorted(named - known - benchmarks - OTHERS) == [], "options that do not exist"


def test_each_option_has_a_help_that_names_the_thing():
    """Not "of the wheels" or "default: demo": a reader sees the name of the option, and wants a noun."""
    vague = ("of", "those", "what", "such", "where", "only", "evenly", "default:")
    wrong = []
    for name, parser in inner(make_parser(list(COMMANDS))).items():
        for own in (parser, *inner(parser).values()):
            for action in own._actions:
                if not isinstance(action, argparse._SubParsersAction):
                    first = (action.help or "of").split()[0]
                    wrong += [f"{name}: {action.dest}: {action.help}"] * (first in vague)
    assert wrong == []


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
# The snippets of python.md are run by test_python_page.py.
BLOCKS = [
    block
    for page in PAGES
    if page.stem != "python"
    for block in PYTHON.findall(page.read_text("utf-8"))
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
    if "models" in names:
        assert names["models"] == (), "two images make no model"
    else:
        assert names["match"].estimate.inlier_count > 50


def test_the_lines_of_a_fact_of_a_result_are_the_ones_of_its_files():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    example = page.partition("- **A fact of a result**")[2].partition("\n- ")[0]
    rows = re.findall(r"^  \| `(\S+\.py)`.*\| `(.*)` \|$", example, re.M)
    assert len({file for file, _ in rows}) == len(rows) == 3
    for file, line in rows:
        # A bar within a cell is escaped.
        text = (ROOT / "mkpc_kaggle" / file).read_text(encoding="utf-8")
        assert f"    {line}\n".replace("\\|", "|") in text, (file, line)


def test_a_folder_uses_those_above_it_and_never_those_below():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    folders = re.findall(r"^\| `(\w+)/` \|", page, re.M)
    order = ["errors", "version", "config", "progress", "cores", folders[0], "recipe", *folders[1:]]
    package = ROOT / "mkpc_kaggle"
    found = {path.name for path in package.iterdir() if (path / "__init__.py").is_file()}
    assert found == set(folders)
    # Also imports within functions, which no import at the start would show.
    importing = re.compile(r"^\s*(?:from|import) mkpc_kaggle\b\.?(\w*)", re.M)
    for path in package.glob("*/**/*.py"):
        layer = order.index(path.relative_to(package).parts[0])
        used = importing.findall(path.read_text(encoding="utf-8"))
        assert [name for name in used if name not in order[: layer + 1]] == [], path


def test_the_store_uses_no_other_room_of_the_engine_and_the_plan_no_worker():
    engine = ROOT / "mkpc_kaggle" / "engine"
    importing = re.compile(r"^\s*(?:from|import) mkpc_kaggle\.engine\.(\w+)", re.M)
    for room, forbidden in {"store": {"plan", "workers"}, "plan": {"workers"}}.items():
        for path in (engine / room).glob("*.py"):
            used = set(importing.findall(path.read_text(encoding="utf-8")))
            assert used.isdisjoint(forbidden), path


def test_references_to_modules_name_modules_that_exist():
    package = ROOT / "mkpc_kaggle"
    wrong = []
    for path in sorted(package.rglob("*.py")):
        for name in re.findall(r":mod:`([^`]+)`", path.read_text(encoding="utf-8")):
            # A short name is a module of the same folder.
            inner = name.removeprefix("mkpc_kaggle").lstrip(".").replace(".", "/")
            base = package if name.startswith("mkpc_kaggle") else path.parent
            if not ((base / f"{inner}.py").is_file() or (base / inner).is_dir()):
                wrong.append(f"{path.relative_to(package)}: {name}")
    assert wrong == []


def test_no_error_of_any_type_is_dropped():
    # Such a block turns a limit of a library into "no information".
    dropped = re.compile(r"suppress\((Base)?Exception\b|except( (Base)?Exception)?:\s+pass\b")
    files = sorted((ROOT / "mkpc_kaggle").rglob("*.py"))
    assert [str(path) for path in files if dropped.search(path.read_text(encoding="utf-8"))] == []


def uses_of_functions() -> dict[str, set[str]]:
    """The files of the package that call each function, or read each property, besides its own."""
    package = ROOT / "mkpc_kaggle"
    calls: dict[str, set[str]] = {}
    reads: dict[str, set[str]] = {}
    homes: dict[str, set[str]] = {}
    for path in sorted(package.rglob("*.py")):
        file = path.relative_to(package).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
                    calls.setdefault(name, set()).add(file)
                case ast.Attribute(attr=name):
                    reads.setdefault(name, set()).add(file)
                case ast.FunctionDef(name=name):
                    homes.setdefault(name, set()).add(file)
    # A file that defines the function may also call another one of the same name.
    return {
        name: calls.get(name, reads.get(name, set())) - (files if len(files) == 1 else set())
        for name, files in homes.items()
    }


def test_only_the_files_that_contributing_names_call_the_functions_that_decide():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    _, _, part = page.partition("**Where it is decided**")
    rows = re.findall(r"^\| .*? \| .*? \| (`.*?) \|$", part, re.M)
    assert len(rows) == 15
    uses = uses_of_functions()
    checked = 0
    for row in rows:
        for each in row.split(";"):
            names, _, places = each.partition(":")
            functions = {name for name in re.findall("`([a-z_]+)`", names) if name in uses}
            if not functions:
                continue  # a sentence about another file
            files = set(re.findall(r"`(\S+\.py)`", places))
            assert set().union(*(uses[name] for name in functions)) == files, each
            checked += 1
    assert checked >= len(rows)


HEADS = {
    time_limits: [
        (
            "2 % of the limit of the run but 5 to 60 s",
            (100 * SILENCE_SHARE, MIN_SILENCE_S, MAX_SILENCE_S),
        ),
        ("30 times the mean", time_limits.HANG_FACTOR),
        ("a quarter of the time", 1 / time_limits.UNKNOWN_SHARE),
        ("an hour at most", time_limits.MAX_UNKNOWN_S / 3600),
        ("30 s a pair", time_limits.HANG_FACTOR * time_limits.UNMEASURED_ESTIMATE_S),
        ("at least of 3 s and 0.5 ms per match", (SCENE_START_S, 1000 * SCENE_MATCH_S)),
        ("has 300 s for matchers", time_limits.MATCHERS_START_S),
    ],
    schedule: [
        ("40 % after one and 1 % after many", (100 * MARGIN, 100 * MIN_MARGIN)),
        ("a fifth of the limit", 1 / schedule.RESERVE_SHARE),
        ("beyond a tenth of it", 1 / schedule.CONNECT_SHARE),
        ("after a quarter of it", 1 / TRIAL_SHARE),
    ],
    choose: [
        ("60 or more", choose.EVIDENCE_MATCHES),
        ("less than half", 1 / choose.EVIDENCE_SHARE),
        ("2 px", choose.CONTRADICTION_ERROR_PX),
        ("30 matches or more", choose.CONTRADICTION_MATCHES),
        ("5 %", 100 * choose.CONTRADICTION_SHARE),
    ],
    robust: [
        ("0.2 px of the stored", RobustConfig().threshold),
        (
            "50,000 iterations; `reconstruct` has 2,000",
            (RobustConfig().max_iterations, MAGSAC_ITERATIONS),
        ),
        ("0.4 for rough starts", ESSENTIAL_THRESHOLD_PX),
        ("1.0 for the support", AGREEMENT_PX),
        ("2.0 for matches", choose.CONTRADICTION_ERROR_PX),
        ("2.0 and 4.0 for homographies", (TRANSFER_PX, MAX_TRANSFER_PX)),
    ],
    critical_region: [
        ("``eps``, 0.05 in", MkpcConfig().eps),
        ("Above 2,000 points", critical_region.MERGE_ABOVE),
    ],
    assumptions: [
        ("fewer than half", 1 / assumptions.MIN_REGISTERED),
        ("moved by 30 %", 100 * (math.exp(assumptions.MAX_EXIF_LOG_DEVIATION) - 1)),
    ],
    crop_need: [("(1.9)", MkpcConfig().min_scale), ("(2.0)", MkpcConfig().min_detail)],
    densify: [
        ("up to 2,000 images", densify.MAX_IMAGES),
        ("is 10 by", SceneConfig().pairs_per_image),
    ],
    shared_intrinsics: [
        ("at least five images", shared_intrinsics.MIN_ALIKE),
        ("within 2 %, :func:", 100 * shared_intrinsics.TOLERANCE),
        ("fewer than 0.99", MIN_OBSERVATIONS),
        ("differ by 10 %", 100 * shared_intrinsics.EXIF_TOLERANCE),
        ("within 0.5 % at the edge", 100 * MIN_DISPLACEMENT),
    ],
}
WORDS = {"half": 2, "fifth": 5, "tenth": 10, "quarter": 4, "hour": 1, "five": 5}


@pytest.mark.parametrize("module", HEADS, ids=lambda module: module.__name__)
def test_numbers_in_heads_are_those_of_the_code(module):
    head = " ".join(module.__doc__.split())
    for text, values in HEADS[module]:
        assert text in head, text
        numbers = [float(number.replace(",", "")) for number in re.findall(r"\d[\d,.]*\d|\d", text)]
        numbers = numbers or [
            float(WORDS[word]) for word in re.findall(r"[a-z]+", text) if word in WORDS
        ]
        expected = values if isinstance(values, tuple) else (values,)
        assert numbers == pytest.approx(expected), text


def test_shipped_recipes_change_neither_the_threshold_nor_eps():
    for path in sorted((ROOT / "mkpc_kaggle" / "recipes").glob("*.toml")):
        recipe = load_recipe(path.stem)
        assert recipe.magsac.threshold == RobustConfig().threshold
        assert recipe.magsac.threshold_side == 0
        assert recipe.mkpc.eps == MkpcConfig().eps
        is_of_the_paper = path.stem in ("imc2022", "yfcc", "scannet")
        assert recipe.magsac.permutations == (8 if is_of_the_paper else 1)
