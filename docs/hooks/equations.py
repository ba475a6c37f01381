"""Equations without a script from elsewhere: Matplotlib draws what stands between dollar signs."""

import html
import io
import re
from functools import cache
from typing import Any

from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import math_to_image

_INLINE = re.compile(r'<span class="arithmatex">\\\((.+?)\\\)</span>', re.DOTALL)
_DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.+?)\\\]\s*</div>', re.DOTALL)
_SIZE = 12.0  # points


@cache
def picture(latex: str) -> str:
    """An ``<svg>`` of an equation; its text stays with it. Raises ValueError for what Matplotlib
    cannot set."""
    file = io.StringIO()
    font = FontProperties(size=_SIZE, math_fontfamily="cm")
    math_to_image(f"${latex}$", file, prop=font, format="svg")
    drawn = file.getvalue()
    drawn = drawn[drawn.index("<svg") :].replace("<svg", '<svg class="equation" role="img"', 1)
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, flags=re.DOTALL)
    unique = f"e{abs(hash(latex)):x}-"  # identifiers of glyphs must differ within a page
    drawn = re.sub(r'id="', f'id="{unique}', drawn)
    drawn = re.sub(r'href="#', f'href="#{unique}', drawn)
    drawn = re.sub(r"url\(#", f"url(#{unique}", drawn)
    return re.sub(r"(<svg[^>]*>)", rf"\1<title>{html.escape(latex)}</title>", drawn, count=1)


def on_page_content(content: str, **_: Any) -> str:
    def inline(found: re.Match[str]) -> str:
        return picture(html.unescape(" ".join(found[1].split())))

    def display(found: re.Match[str]) -> str:
        return f'<div class="equation">{inline(found)}</div>'

    return _INLINE.sub(inline, _DISPLAY.sub(display, content))
