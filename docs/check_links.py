"""Checks the links of the built site and of the README: ``python docs/check_links.py docs/_build/html``.

Every link, picture, style and script within the site must exist, with its anchor. Pages load nothing from other hosts,
so that the site can be read offline, and this check needs no network.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "CONTRIBUTING.md")
"""Markdown that is not a part of the site."""


class Page(HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Collects the anchors and links of an element."""
        values = {name: value or "" for name, value in attributes}
        self.anchors.update(values[name] for name in ("id", "name") if name in values)
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag == "link" and values.get("rel") != "canonical":
            self.loaded.append(values.get("href", ""))
        elif "src" in values:
            self.loaded.append(values["src"])


def broken_links(site: Path) -> list[str]:
    """Returns a line for each broken link of a built site.

    Raises:
        FileNotFoundError: if the folder holds no site.
    """
    if not (site / "index.html").is_file():
        raise FileNotFoundError(f"{site} holds no index.html; build the site first: make docs")
    pages = {path.resolve(): Page(path) for path in sorted(site.rglob("*.html"))}
    broken = []
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        broken += [f"{name} loads {url} from another host" for url in page.loaded if urlsplit(url).netloc]
        for url in dict.fromkeys((*page.links, *page.loaded)):
            parts = urlsplit(url)
            if parts.scheme or parts.netloc or url in ("", "#"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                broken.append(f"{name} links to {url}, which does not exist")
            elif target in pages and parts.fragment and unquote(parts.fragment) not in pages[target].anchors:
                broken.append(f"{name} links to {url}, which has no such anchor")
    return broken


def broken_markdown_links(site: Path) -> list[str]:
    """Returns a line for each link of ``PAGES`` to a file, or to a heading of the site, that does not exist."""
    broken = []
    for name in PAGES:
        for url in re.findall(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"", (ROOT / name).read_text(encoding="utf-8")):
            parts = urlsplit("".join(url))
            if parts.netloc:
                continue
            built = site / Path(parts.path).with_suffix(".html").name
            if not (ROOT / parts.path).exists() or (parts.fragment and parts.fragment not in Page(built).anchors):
                broken.append(f"{name} links to {parts.geturl()}, which does not exist")
    return broken


def main(site: Path) -> int:
    """Prints the broken links and returns the exit code."""
    broken = broken_links(site) + broken_markdown_links(site)
    print("\n".join(broken) or "All links of the site work")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
