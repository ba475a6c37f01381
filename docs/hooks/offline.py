"""The site works without network: a page that loads a script, a style or a picture from elsewhere
fails the build."""

import re
from typing import Any

_LOADED = re.compile(
    r'<(?:script|img|iframe)[^>]*\ssrc="(?:https?:)?//[^"]+"'
    r'|<link[^>]*rel="(?:stylesheet|preconnect|icon|shortcut icon)"[^>]*href="(?:https?:)?//[^"]+"'
)


_DIAGRAMS = re.compile(
    r'<script type="module">(?:(?!</script>).)*jp-Mermaid.*?</script>', re.DOTALL
)
"""What nbconvert adds to notebooks, for diagrams that ours do not have: it would load Mermaid."""


def on_post_page(output: str, page: Any, **_: Any) -> str:
    output = _DIAGRAMS.sub("", output)
    found = _LOADED.search(output)
    if found is not None:
        raise ValueError(f"{page.file.src_uri} loads from elsewhere: {found[0]}")
    return output
