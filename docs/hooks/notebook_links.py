"""Links between pages in notebooks, which mkdocs leaves as they are: a link to a page that is not
there fails the build, as it does in Markdown."""

import posixpath
import re
from typing import Any

_PAGE = re.compile(r'href="(?!https?:)(?P<path>[^"#]+\.(?:md|py))(?P<anchor>#[^"]*)?"')


def on_page_content(content: str, page: Any, files: Any, **_: Any) -> str:
    if page.file.src_uri.endswith(".md"):
        return content

    def linked(found: re.Match[str]) -> str:
        folder = posixpath.dirname(page.file.src_uri)
        target = files.get_file_from_path(posixpath.normpath(posixpath.join(folder, found["path"])))
        if target is None:
            raise ValueError(f"{page.file.src_uri} links to {found['path']}, which is no page")
        return f'href="{target.url_relative_to(page.file)}{found["anchor"] or ""}"'

    return _PAGE.sub(linked, content)
