"""Pages of the documentation site that are made from other files: README, options, linked files.

MkDocs calls the functions `on_…` (`hooks` in `mkdocs.yml`). The home page is the README. Each
config group has a page with its options as they stand in YAML. A link from a page to a file or a
folder of the repository leads to a copy in the site, so that the site needs nothing else.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from brokk_rl import registry

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")
"""A Markdown link to a relative path, with or without an anchor."""
CODE = {".py": "python", ".yaml": "yaml", ".toml": "toml", ".service": "ini", ".cff": "yaml"}
"""Files that are shown as pages, and the language of their code block."""
OWN_PAGES = {"README.md": "index.md"}
"""Pages of the site whose source stands outside `docs`."""
COMMANDS = re.compile(r"^```\n(.*?)^```", re.MULTILINE | re.DOTALL)
"""A block of commands: it names no language."""
COMMENT = re.compile(r"^(\S.*?) {2,}# (.+)$", re.MULTILINE)
"""A command and the comment behind it."""
COLUMNS = 84
"""Characters of a line of code that a window of 1,280 px shows; longer lines break."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the config groups into the navigation."""
    groups = [{group: name_group_page(group)} for group in list_groups()]
    config.nav[-1]["Reference"].append({"Options by group": groups})  # pyright: ignore[reportOptionalSubscript]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add home page, config groups, and everything that pages link to outside of `docs`."""
    add_text(files, config, "index.md", (ROOT / "README.md").read_text())
    for group, options in list_groups().items():
        add_text(files, config, name_group_page(group), "\n".join(describe_group(group, options)))
    sources = [f"docs/{file.src_uri}" for file in files.documentation_pages() if file.abs_src_path]
    waiting = ["README.md", *(name for name in sources if (ROOT / name).is_file())]
    seen = set(waiting)
    while waiting:
        page = waiting.pop()
        for target in find_targets(page):
            if target in seen or target.startswith("docs/"):
                continue
            seen.add(target)
            if add_target(files, config, target) and target.endswith(".md"):
                waiting.append(target)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page with links that lead to places in the site, and comments that can be seen."""
    markdown = COMMANDS.sub(lambda block: move_comments(block[0]), markdown)
    source = read_source_path(page.file)
    return markdown if source is None else move_links(markdown, source, page.file.src_uri)


def move_comments(block: str) -> str:
    """Return a block of commands, each comment above its command where a line is too long."""
    if all(len(line) <= COLUMNS for line in block.splitlines()):
        return block
    return COMMENT.sub(r"# \2\n\1", block)


def list_groups() -> dict[str, list[registry.Option]]:
    """Return the options of each config group."""
    groups: dict[str, list[registry.Option]] = {}
    for option in registry.list_options():
        groups.setdefault(option.group, []).append(option)
    return groups


def name_group_page(group: str) -> str:
    """Return the path of a config group's page in the site."""
    return f"reference/options/{group.replace('/', '_')}.md"


def describe_group(group: str, options: list[registry.Option]) -> Iterator[str]:
    """Yield the lines of a config group's page."""
    yield f"# {group}\n"
    yield f"Choose one with `{group}=<option>`, or a file of your own with `{group}=@<file>`.\n"
    for option in options:
        text = option.path.read_text()
        target = re.search(r"^_target_: *(\S+)", text, re.MULTILINE)
        yield f"## {option.name}\n"
        yield f"{option.comment() or option.summary()}\n"
        yield f"```yaml\n{text.strip()}\n```\n"
        attributes = registry.read_attributes(target[1]) if target else {}
        if attributes:
            yield "| value | meaning |\n|---|---|"
            for name, meaning in attributes.items():
                yield f"| `{name}` | {' '.join(meaning.split()).replace('|', chr(92) + '|')} |"
            yield ""


def add_text(files: Files, config: MkDocsConfig, place: str, text: str) -> None:
    """Add a page with the given text."""
    files.append(File.generated(config, place, content=text))


def add_target(files: Files, config: MkDocsConfig, target: str) -> bool:
    """Add a file or folder of the repository; return whether it exists."""
    path = ROOT / target
    if path.is_dir():
        names = sorted(one.name + "/" * one.is_dir() for one in path.iterdir())
        lines = [f"# {target}\n"]
        for name in names:
            inner = f"{target}/{name.rstrip('/')}"
            add_target(files, config, inner)
            link = posixpath.relpath(locate_target(inner), target_folder(target))
            lines.append(f"* [{name}]({link})")
        add_text(files, config, locate_target(target), "\n".join(lines))
    elif path.suffix in CODE:
        text = path.read_text().rstrip()
        code = f"# {target}\n\n````{CODE[path.suffix]}\n{text}\n````\n"
        add_text(files, config, locate_target(target), code)
    elif path.is_file() and files.get_file_from_path(locate_target(target)) is None:
        files.append(File.generated(config, locate_target(target), abs_src_path=str(path)))
    return path.exists()


def find_targets(page: str) -> Iterator[str]:
    """Yield the paths, from the repository's root, to which a page links."""
    for match in LINK.finditer((ROOT / page).read_text()):
        yield posixpath.normpath(posixpath.join(posixpath.dirname(page), match[2]))


def target_folder(target: str) -> str:
    """Return the folder of a folder's page in the site."""
    return posixpath.dirname(locate_target(target))


def locate_target(target: str) -> str:
    """Return where a path of the repository stands in the site."""
    if target in OWN_PAGES:
        return OWN_PAGES[target]
    if target.startswith("docs/"):
        return target.removeprefix("docs/")
    if (ROOT / target).is_dir():
        return f"files/{target}/index.md"
    return f"files/{target}" + (".md" if Path(target).suffix in CODE else "")


def read_source_path(file: File) -> str | None:
    """Return the path, from the repository's root, of the file that a page shows."""
    for source, place in OWN_PAGES.items():
        if file.src_uri == place:
            return source
    if file.abs_src_path is None:
        return None
    return Path(file.abs_src_path).resolve().relative_to(ROOT).as_posix()


def move_links(markdown: str, source: str, place: str) -> str:
    """Return text whose relative links lead to the same files from its place in the site."""

    def move(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[2]))
        if not (ROOT / target).exists():
            return match[0]
        link = posixpath.relpath(locate_target(target), posixpath.dirname(place) or ".")
        anchor: Any = match[3] or ""
        return f"{match[1]}{link}{anchor}{match[4]}"

    return LINK.sub(move, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a notebook's page with links to pages instead of Markdown files."""
    if not page.file.src_uri.endswith(".ipynb"):
        return html
    return re.sub(r'(href="[^":]+)\.md(#[^"]*)?"', r'\1.html\2"', html)
