"""Equations without a script from elsewhere: Matplotlib draws what stands between dollar signs."""

import html
import io
import re
import zlib
from functools import cache
from typing import Any

from matplotlib import rc_context
from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import math_to_image

_INLINE = re.compile(r'<span class="arithmatex">\\\((.+?)\\\)</span>', re.DOTALL)
_DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.+?)\\\]\s*</div>', re.DOTALL)
_SIZE = 11.0  # points


@cache
def picture(latex: str) -> str:
    """An ``<svg>`` of an equation, with its source as the title. Raises ValueError for what
    Matplotlib cannot set."""
    file = io.StringIO()
    font = FontProperties(size=_SIZE, math_fontfamily="cm")
    with rc_context({"savefig.transparent": True, "svg.hashsalt": "coloc"}):
        depth = math_to_image(f"${latex}$", file, prop=font, dpi=72, format="svg")
    drawn = file.getvalue()
    drawn = re.sub(r"<(metadata|style).*?</\1>", "", drawn, flags=re.DOTALL)
    unique = f"e{zlib.crc32(latex.encode()):x}-"  # identifiers must differ within a page
    drawn = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{unique}", drawn)
    _, _, inside = drawn[drawn.index("<svg") :].partition(">")
    width, height = re.findall(r'(?:width|height)="([\d.]+pt)"', drawn[:2000])[:2]
    box = re.findall(r'viewBox="[^"]+"', drawn)[0]
    style = f"width:{width};height:{height};vertical-align:-{depth:.1f}pt"
    title = f"<title>{html.escape(latex)}</title>"
    return f'<svg class="equation" role="img" {box} style="{style}">{title}{inside}'


def on_page_content(content: str, **_: Any) -> str:
    def inline(found: re.Match[str]) -> str:
        return picture(html.unescape(" ".join(found[1].split())))

    def display(found: re.Match[str]) -> str:
        return f'<div class="equation">{inline(found)}</div>'

    return _INLINE.sub(inline, _DISPLAY.sub(display, content))
