"""MkDocs hooks: links from the book into the code become the file's path; formulas become MathML, which browsers
draw without a script; nothing is loaded from elsewhere."""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?://|#)([^)#\s]+)\)")

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
FOREIGN = re.compile(r"<(?:script|img|iframe|source|link)\b[^>]*?\s(?:src|href)=[\"']?(?:https?:)?//[^\s>]+")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    here = (ROOT / "docs" / page.file.src_path).parent

    def shown(link: re.Match[str]) -> str:
        target = (here / link[2]).resolve()
        if target.is_relative_to(ROOT / "docs") or not target.exists():
            return link[0]
        return f"{link[1]} (`{target.relative_to(ROOT)}`)"

    return LINK.sub(shown, markdown)


def on_page_content(content: str, **_: Any) -> str:
    def drawn(formula: re.Match[str]) -> str:
        tag, bracket, tex = formula.groups()
        mathml = convert(html.unescape(tex).strip(), display="block" if bracket == "[" else "inline")
        return f'<{tag} class="formula">{mathml}</{tag}>'

    return FORMULA.sub(drawn, content)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    foreign = FOREIGN.search(output)
    if foreign:
        raise PluginError(f"{page.file.src_path} would load from elsewhere: {foreign[0]}")
    if 'class="arithmatex"' in output:
        raise PluginError(f"{page.file.src_path} has a formula that was not drawn")
    return output
