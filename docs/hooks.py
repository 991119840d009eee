"""What the documentation build does beyond MkDocs' own.

Pages also link to files of the source (config/, bags/, test/), which a reader of the source can
follow; the built pages have them as plain text.
"""

from __future__ import annotations

import os
import posixpath
import re
from typing import Any

LINK = re.compile(r'(?<!!)\[([^\]]+)\]\(([^)\s]+)\)')


def on_config(config: Any) -> Any:
    """Leave pages out of the navigation that are not there."""
    config.nav = _present(config.nav, config.docs_dir)
    return config


def _present(items: Any, folder: str) -> list[Any]:
    kept: list[Any] = []
    for item in items:
        [(title, target)] = item.items()
        if isinstance(target, list):
            kept.append({title: _present(target, folder)})
        elif os.path.isfile(os.path.join(folder, target)):
            kept.append(item)
    return kept


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace links that leave the documentation by their text."""
    here = posixpath.dirname(page.file.src_uri)

    def inside(match: re.Match[str]) -> str:
        text, target = match.groups()
        if '://' in target or target.startswith('#'):
            return match.group(0)
        path = posixpath.normpath(posixpath.join(here, target.partition('#')[0]))
        return text if path.startswith('..') else match.group(0)

    return LINK.sub(inside, markdown)
