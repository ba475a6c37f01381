"""The site works without network: a page that loads a script, a style or a picture from elsewhere
fails the build."""

import re
from typing import Any

_LOADED = re.compile(
    r'<(?:script|img|iframe)[^>]*\ssrc="(?:https?:)?//[^"]+"'
    r'|<link[^>]*rel="(?:stylesheet|preconnect|icon|shortcut icon)"[^>]*href="(?:https?:)?//[^"]+"'
)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    found = _LOADED.search(output)
    if found is not None:
        raise ValueError(f"{page.file.src_uri} loads from elsewhere: {found[0]}")
    return output
