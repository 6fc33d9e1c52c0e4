"""HTML that cannot forget to escape: text is escaped where it enters an element, markup is not.

One page, no script, no request: pictures stand inside, colours follow the reader's scheme.
"""

import base64
import html
from collections.abc import Iterable, Sequence

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1d21; --dim: #5b616b; --line: #d5d8de; --paper: #ffffff;
  --tint: #f3f5f8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8ec; --dim: #a0a7b3; --line: #3a3f48; --paper: #16181c;
  --tint: #20242a; } }
@media print { :root { color-scheme: light; --ink: #000; --dim: #444; --line: #bbb; --paper: #fff;
  --tint: #fff; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 72rem; padding: 1rem; color: var(--ink); background: var(--paper);
  font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; padding-top: .8rem; border-top: 1px solid var(--line); }
p { margin: .4rem 0; max-width: 46rem; }
.side { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); gap: .3rem 2rem;
  align-items: start; }
.side > p, .side > ul, .pictures { grid-column: 1 / -1; }
.dim, figcaption { color: var(--dim); font-size: .9rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .6rem; margin: 1rem 0; }
.facts > div { background: var(--tint); border: 1px solid var(--line); border-radius: .4rem;
  padding: .5rem .7rem; }
.facts b { display: block; font-size: 1.25rem; line-height: 1.3; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: 1rem; }
figure { margin: 0; break-inside: avoid; }
figure svg, figure img { display: block; width: 100%; height: auto; }
.plot { max-width: 40rem; margin-top: .6rem; }
.wide { overflow-x: auto; margin: .6rem 0; min-width: 0; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .25rem .7rem .25rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
td { min-width: 6rem; }
td.n { min-width: 0; }
th { color: var(--dim); font-weight: 600; white-space: nowrap; }
td.n, th.n { text-align: right; white-space: nowrap; }
tr { break-inside: avoid; }
code { font-size: .9em; }
"""


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(tag: str, *children: object, **attributes: str) -> Markup:
    """An element; children that are not :class:`Markup` are text. ``class_`` stands for ``class``."""
    told = "".join(f' {name.rstrip("_")}="{html.escape(value)}"' for name, value in attributes.items())
    return Markup(f"<{tag}{told}>{join(children)}</{tag}>")


def join(children: Iterable[object]) -> Markup:
    return Markup("".join(one if isinstance(one, Markup) else html.escape(str(one)) for one in children))


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> Markup:
    """A table that scrolls sideways where it is too wide; columns of numbers stand to the right."""
    rows = list(rows)
    kinds = ["n" if rows and all(_is_number(row[i]) for row in rows) else "" for i in range(len(heads))]
    head = element("tr", *(_cell("th", name, kind) for name, kind in zip(heads, kinds, strict=True)))
    body = [element("tr", *(_cell("td", v, k) for v, k in zip(row, kinds, strict=True))) for row in rows]
    whole = element("table", element("thead", head), element("tbody", *body))
    return element("div", whole, class_="wide")


def picture(data: bytes, kind: str, caption: object, alternative: str) -> Markup:
    """An image of the media type ``kind`` that stands in the page itself."""
    source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
    image = Markup(f'<img src="{source}" alt="{html.escape(alternative)}">')
    return element("figure", image, element("figcaption", caption))


def page(title: str, *children: object) -> Markup:
    """A whole document."""
    head = (
        Markup('<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'),
        element("title", title),
        element("style", Markup(_STYLE)),
    )
    document = element("html", element("head", *head), element("body", *children), lang="en")
    return join([Markup("<!doctype html>\n"), document])


def _cell(tag: str, value: object, kind: str) -> Markup:
    return element(tag, value, class_=kind) if kind else element(tag, value)


def _is_number(value: object) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True
