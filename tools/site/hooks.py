# SPDX-License-Identifier: Apache-2.0
"""Additions to MkDocs: pages from outside docs/, navigation from docs/index.md, links, lists, equations.

MkDocs calls the functions by their names; mkdocs.yml names this file.
"""

import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import api
from equations import KATEX, EquationError, Equations
from gfm import for_python_markdown
from workplace import NODE, ROOT

DOCS = ROOT / "docs"
ROOT_PAGES = {"README.md": "start.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
MERMAID = "assets/mermaid.js"
LISTS = {"reference.md", "changelog.md", "contributing.md", "tests.md", "licences.md", "performance.md"}  #: found last
SECTIONS = "## All pages"  # of docs/index.md; a heading below is a section, a link that begins an item a page of it

_SECTION = re.compile(r"^### (.+)$|^- \[(.+?)\]\((.+?)\)", re.MULTILINE)
_ALL = re.MULTILINE | re.DOTALL
_LINK = re.compile(r"(^ *(`{3,}).*?^ *\2$|(`+)(?!`).+?(?<!`)\3(?!`))|(\]\()([^)\s#:]+)(#[^)\s]*)?\)", _ALL)
_DIAGRAM = re.compile(r'<pre class="mermaid">.*?</pre>', re.DOTALL)
_equations: list[Equations] = []


def slug(heading: str, separator: str) -> str:
    """Return the anchor of a heading, the same as on GitHub."""
    return re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", separator)


def navigation() -> list[Any]:
    """Return the navigation: the sections and pages that docs/index.md lists, and the Python interface."""
    _, _, listed = (DOCS / "index.md").read_text(encoding="utf-8").partition(f"\n{SECTIONS}\n")
    listed = re.sub(r"<!--.*?-->", "", listed, flags=re.DOTALL)
    found: list[Any] = [{"In a minute": "index.md"}]
    for section, title, target in _SECTION.findall(listed):
        if section:
            found.append({section: []})
        else:
            next(iter(found[-1].values())).append({title: site_path((DOCS / target).resolve())})
    python = {"Python": [{package: f"{api.FOLDER}/{package}.md"} for package in api.PACKAGES]}
    next(iter(found[-1].values())).append(python)
    return found


def site_path(path: Path) -> str:
    """Return where in the site a file of the checkout is, with its anchor if it is a part of a page."""
    relative = path.relative_to(ROOT).as_posix()
    if relative in ROOT_PAGES:
        return ROOT_PAGES[relative]
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    return api.place(path) or f"files/{relative}"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Set what mkdocs.yml cannot say."""
    config.nav = navigation()
    config.mdx_configs["toc"]["slugify"] = slug
    return config


def on_pre_build(config: MkDocsConfig) -> None:
    """Start the renderer of equations."""
    _equations.append(Equations())


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is not in docs/."""
    pages = {place: (ROOT / name).read_text(encoding="utf-8") for name, place in ROOT_PAGES.items()}
    # What README.md begins with, docs/index.md says.
    pages["start.md"] = "# Start\n\n## " + pages["start.md"].partition("\n## ")[2]
    bare = os.environ.get("LATHE_DOCS") == "bare"
    pages |= {f"{api.FOLDER}/{package}.md": api.page(package, bare=bare) for package in api.PACKAGES}
    for place, text in pages.items():
        files.append(File.generated(config, place, content=text))
    assets = {
        "assets/site.css": HERE / "site.css",
        "assets/favicon.svg": HERE / "favicon.svg",
        "assets/katex/katex.min.css": KATEX / "dist" / "katex.min.css",
        MERMAID: NODE / "node_modules" / "@mermaid-js" / "tiny" / "dist" / "mermaid.tiny.js",
    }
    assets |= {f"assets/katex/fonts/{path.name}": path for path in (KATEX / "dist" / "fonts").glob("*.woff2")}
    for place, path in assets.items():
        files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links into the site, take equations out, and write lists as Python-Markdown reads them."""
    own = page.file.src_uri.startswith(f"{api.FOLDER}/")
    if own or page.file.src_uri in LISTS:
        page.meta["search"] = {"boost": 1e-4}  # headings count a thousand times as much as text
    if own:
        return markdown
    by_place = {place: name for name, place in ROOT_PAGES.items()}
    source = ROOT / by_place[page.file.src_uri] if page.file.src_uri in by_place else DOCS / page.file.src_uri

    def link(found: re.Match[str]) -> str:
        if found[1]:
            return found[0]
        path = (source.parent / found[5]).resolve()
        if not path.is_file():
            return found[0]
        place, _, anchor = site_path(path).partition("#")
        if place.startswith("files/") and place not in files.src_uris:
            files.append(File.generated(config, place, abs_src_path=str(path)))
        target = posixpath.relpath(place, posixpath.dirname(page.file.src_uri) or ".")
        return f"{found[4]}{target}{found[6] or (f'#{anchor}' if anchor else '')})"

    try:
        text = _equations[-1].take_out(_LINK.sub(link, markdown))
    except EquationError as error:
        raise PluginError(f"{source.relative_to(ROOT)}: {error}") from error
    return for_python_markdown(text)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the equations in, and the script that draws diagrams where there are some."""
    if '<pre class="mermaid">' in html:
        script = posixpath.relpath(MERMAID, posixpath.dirname(page.file.dest_uri) or ".")
        html = _DIAGRAM.sub(r'<div class="diagram">\g<0></div>', f'<script src="{script}"></script>\n{html}')
    return _equations[-1].put_in(html)


def on_post_build(config: MkDocsConfig) -> None:
    """End the renderer of equations."""
    _equations.pop().close()
