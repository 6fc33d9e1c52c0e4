"""Help texts, wrapped to the width of the terminal."""

import argparse
import re
import textwrap
from collections.abc import Generator, Iterator

LIST_INDENT = "  "  # an item of a list begins with it; lines that belong to the item have more
ITEM = re.compile(r" +\S+(?: \S+)*? {2,}")  # the first of two columns, with the blanks after it
COMMAND = re.compile(r" +(?:mkpc|kaggle|python) ")


class HelpFormatter(argparse.HelpFormatter):
    """Formatter that wraps paragraphs, and the second column of lists.

    argparse either joins all lines of a description into one paragraph or wraps none.
    """

    def _iter_indented_subactions(self, action: argparse.Action) -> Generator[argparse.Action]:
        # argparse computes the column of the texts without this indentation, which makes the
        # longest command wrap.
        find = getattr(action, "_get_subactions", None)
        if find is not None:
            yield from find()

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(indent + wrapped(line, width) for line in logical_lines(text))


def logical_lines(text: str) -> Iterator[str]:
    """Yield the paragraphs and list items of a text, each joined to one line, and the empty lines."""
    collected = ""
    for line in text.rstrip().splitlines():
        is_item = line.startswith(LIST_INDENT) and not line.startswith(f"{LIST_INDENT} ")
        after_item = collected.startswith(LIST_INDENT) and not line.startswith(LIST_INDENT)
        if collected and line and not is_item and not after_item:
            collected += f" {line.strip()}"
            continue
        if collected:
            yield collected
        if not line:
            yield ""
        collected = line
    if collected:
        yield collected


def wrapped(line: str, width: int) -> str:
    """Wrap a line; an item's second column stays a column. Commands are not wrapped, to be copied."""
    if COMMAND.match(line):
        return line
    item = ITEM.match(line)
    if item is not None:
        head = item.group()
        body = line[item.end() :]
    else:
        head = line[: len(line) - len(line.lstrip())]
        body = line.lstrip()
    rest = " " * len(head)
    return textwrap.fill(body, width, initial_indent=head, subsequent_indent=rest)
