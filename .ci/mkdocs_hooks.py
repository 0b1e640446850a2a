"""Hooks of mkdocs, so that the same files serve a code host and the site: top-level pages, links, docstrings."""

import os
import re
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from reference import page as reference_page

ROOT = Path(__file__).resolve().parent.parent
PAGES = {"README.md": "overview.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
STYLE = ".md-typeset td code {word-break: normal}\n"  # keep keys on one line
REMOTE_ASSET = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
API_NAME = re.compile(r"\[(\**`(\w+)`\**)\]\(\.\./(pickplace/[\w/]+)\.py\)")  # a name in a table of api.md
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


def on_files(files, config):
    """Add the top-level pages, the reference of all settings and the style sheet."""
    for source, name in PAGES.items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / source)))
    files.append(File.generated(config, "reference.md", content=reference_page()))
    files.append(File.generated(config, "site.css", content=STYLE))
    return files


def add_docstrings(markdown):
    """Put the docstrings of the names in each table below it, and point the names at them."""
    parts = re.split(r"(?=^## )", markdown, flags=re.MULTILINE)
    for number, part in enumerate(parts):
        paths = [f"{module.replace('/', '.')}.{name}" for _, name, module in API_NAME.findall(part)]
        linked = API_NAME.sub(lambda name: f"[{name[1]}][{name[3].replace('/', '.')}.{name[2]}]", part)
        parts[number] = linked + "".join(f"\n::: {path}\n" for path in paths) + "\n"
    return "".join(parts)


def on_page_markdown(markdown, page, config, files):
    """Point links at pages of the site; links to other files become plain text. Add docstrings to api.md."""
    if page.file.src_uri == "api.md":
        markdown = add_docstrings(markdown)
    place = {name: source for source, name in PAGES.items()}.get(page.file.src_uri)
    folder = ROOT if place else ROOT / "docs" / Path(page.file.src_uri).parent

    def point(match):
        image, words, target = match.groups()
        if "://" in target or target.startswith("#"):
            return match[0]
        path, _, anchor = target.partition("#")
        file = Path(os.path.normpath(folder / path))
        if not file.exists():
            return match[0]  # mkdocs reports it
        inside = os.path.relpath(file, ROOT / "docs")
        name = PAGES.get(os.path.relpath(file, ROOT), inside)
        if files.get_file_from_path(name) is None:
            return words
        return f"{image}[{words}]({os.path.relpath(name, Path(page.file.src_uri).parent)}{'#' * bool(anchor)}{anchor})"

    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)  # do not change code
    return "".join(part if part.startswith("```") else LINK.sub(point, part) for part in parts)


def on_page_content(html, **kwargs):
    """Show the ``:class:`Name``` of docstrings as code."""
    return re.sub(r":(?:class|func|meth|mod|attr):<code>~?([\w.]+)</code>", r"<code>\1</code>", html)


def on_post_page(output, page, config):
    """Refuse pages that load anything from another host."""
    if found := REMOTE_ASSET.search(output):
        raise PluginError(f"{page.file.src_uri}: expected no asset of another host, got {found[0]}")
