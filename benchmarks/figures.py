"""Figures of the documentation, made from the files that measured them.

    python benchmarks/figures.py            # list: what is out of date, what has no file
    python benchmarks/figures.py write      # put today's figures into the pages

Each file in `benchmarks/figures` holds the claims of one page. A claim is a passage of the page as a
Jinja template over the JSON files of its measurement. The page has to hold the passage word for word
as the template renders it.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import statistics
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import yaml

ROOT = Path(__file__).resolve().parents[1]
CLAIMS = ROOT / "benchmarks/figures"
PAGES = (
    *map(Path, ("README.md", "benchmarks/README.md")),
    *sorted(path.relative_to(ROOT) for path in ROOT.glob("docs/*.md")),
)
FIGURE = r"[-+−]?(?:[0-9][0-9,]*)?\.?[0-9]+"
"""A number as pages print it, with or without a zero before the point; a comma separates thousands."""
OPEN, CLOSE = "\x01", "\x02"
"""Stand around what a template computes, so that its figures can be told from its words."""


class FigureError(Exception):
    """A claim that cannot be rendered, or a page that does not hold its passage once."""


@dataclass(frozen=True)
class Claim:
    """A passage of a page and the measurement that it rests on.

    Attributes:
        name: Name in lists, `<page>: <claim>`.
        page: The page, from the project's root.
        sources: JSON, JSON lines or CSV files by their names in the template, from `benchmarks`.
        commit: Commit that was measured; where nobody noted it, the one that brought the file.
        rests_on: Number of episodes, trials or scenes, and the machine that ran them.
        command: Command that writes the files again.
        measures: Folders and files of the project whose code the figures depend on.
        text: The passage, a Jinja template.
    """

    name: str
    page: Path
    sources: dict[str, str]
    commit: str
    rests_on: str
    command: str
    measures: tuple[str, ...]
    text: str

    def render(self) -> str:
        """Return the passage as the page should hold it.

        Raises:
            FigureError: a file or a value that the template names is missing.
        """
        return self._render(str)

    def locate(self, page: str) -> tuple[int, int]:
        """Return where the passage stands in the text of its page, whatever its figures are.

        Raises:
            FigureError: the passage is not there, or is there twice.
        """
        marked = self._render(lambda value: f"{OPEN}{value}{CLOSE}")
        # A macro's result is marked again around its own figures: only the innermost marks count.
        pattern = ""
        for k, part in enumerate(re.split(f"{OPEN}({FIGURE}){CLOSE}", marked)):
            words = part.replace(OPEN, "").replace(CLOSE, "")
            pattern += FIGURE if k % 2 else re.escape(words)
        found = list(re.finditer(pattern, page))
        if len(found) != 1:
            raise FigureError(
                f"{self.name}: expected the passage once in {self.page}, found it {len(found)} times; "
                f"the page and the template in {CLAIMS.relative_to(ROOT)} must have the same words"
            )
        return found[0].span()

    def _render(self, finalize: Callable[[Any], str]) -> str:
        environment = jinja2.Environment(
            undefined=jinja2.StrictUndefined,
            finalize=finalize,
            trim_blocks=True,
            lstrip_blocks=True,
            autoescape=False,  # Markdown from this repository, not from outside
        )
        environment.filters.update(FILTERS)
        try:
            files = {name: read_source(source) for name, source in self.sources.items()}
            return environment.from_string(self.text).render(files).strip("\n")
        except (
            OSError,
            ValueError,
            jinja2.TemplateError,
            TypeError,
            LookupError,
            ArithmeticError,
        ) as error:
            raise FigureError(f"{self.name}: {error}") from error


@cache
def read_source(source: str) -> Any:
    """Return the values of a JSON, JSON lines or CSV file below `benchmarks`."""
    path = ROOT / "benchmarks" / source
    text = path.read_text()
    if path.suffix == ".jsonl":
        return [json.loads(line) for line in text.splitlines()]
    if path.suffix == ".csv":
        return list(csv.DictReader(text.splitlines()))
    return json.loads(text)


def format_figure(value: float, decimals: int = 3) -> str:
    """Return a number with its decimals, thousands separated by commas."""
    return f"{float(value):,.{decimals}f}"


def pick(rows: Iterable[dict[str, Any]], **equal: Any) -> list[dict[str, Any]]:
    """Return the rows whose values equal those named; a name that ends in `_` is a prefix."""
    found = []
    for row in rows:
        if all(
            str(row[name[:-1]]).startswith(str(value)) if name.endswith("_") else row[name] == value
            for name, value in equal.items()
        ):
            found.append(row)
    if not found:
        raise ValueError(f"no row has {equal}")
    return found


def collect(rows: Sequence[Any], path: str) -> list[Any]:
    """Return a value of each row; `path` names the keys on the way, with `/` between them."""
    found = []
    for row in rows:
        value = row
        for key in path.split("/"):
            value = value[int(key)] if isinstance(value, list) else value[key]
        found.append(value)
    return found


def shorten_figure(value: float, decimals: int = 2) -> str:
    """Return a number without a zero before its point, as wide tables print it."""
    return re.sub(r"^(-?)0\.", r"\1.", format_figure(value, decimals))


def sign_figure(value: float, decimals: int = 1) -> str:
    """Return a number with its sign, the minus of typography."""
    return f"{float(value):+,.{decimals}f}".replace("-", "−")


FILTERS: dict[str, Callable[..., Any]] = {
    "f": format_figure,
    "short": shorten_figure,
    "signed": sign_figure,
    "pick": pick,
    "collect": collect,
    "mean": statistics.fmean,
    "spread": statistics.stdev,
}


@cache
def read_claims() -> tuple[Claim, ...]:
    """Return the claims of all pages.

    Raises:
        FigureError: a file of claims lacks a key or has one that nothing reads.
    """
    claims = []
    for path in sorted(CLAIMS.glob("*.yaml")):
        told = yaml.safe_load(path.read_text())
        page, shared = Path(told["page"]), told.get("measurements", {})
        for name, facts in told["claims"].items():
            facts = {**shared.get(facts.get("measurement"), {}), **facts}
            facts.pop("measurement", None)
            try:
                measures = tuple(facts.pop("measures"))
                claims.append(Claim(f"{page}: {name}", page, measures=measures, **facts))
            except (KeyError, TypeError) as error:
                raise FigureError(f"{path.name}: claim {name}: {error}") from error
    return tuple(claims)


def find_drift(claim: Claim) -> str | None:
    """Return how a page differs from its measurement, `None` where it does not."""
    page = (ROOT / claim.page).read_text()
    try:
        start, end = claim.locate(page)
        expected = claim.render()
    except FigureError as error:
        return str(error)
    if page[start:end] == expected:
        return None
    pairs = zip(page[start:end].splitlines(), expected.splitlines(), strict=True)
    lines = [f"  page  {old}\n  files {new}" for old, new in pairs if old != new]
    return "\n".join(
        (f"{claim.name}: figures differ from {', '.join(claim.sources.values())}", *lines)
    )


def write_page(page: Path, claims: Iterable[Claim]) -> int:
    """Put the figures of the files into a page; return how many passages changed."""
    text, changed = (ROOT / page).read_text(), 0
    for claim in claims:
        start, end = claim.locate(text)
        expected = claim.render()
        changed += text[start:end] != expected
        text = text[:start] + expected + text[end:]
    (ROOT / page).write_text(text)
    return changed


def count_commits_since(claim: Claim) -> int | None:
    """Return how many commits changed the measured code since; `None` if git does not know the commit."""
    words = ["git", "-C", str(ROOT), "rev-list", "--count", f"{claim.commit}..HEAD", "--"]
    done = subprocess.run([*words, *claim.measures], capture_output=True, text=True)
    return int(done.stdout) if done.returncode == 0 else None


def count_figures(page: Path) -> tuple[int, int]:
    """Return how many decimal figures a page has, and how many of them a claim makes."""
    text = (ROOT / page).read_text()
    pattern = re.compile(r"[0-9]+\.[0-9]+")
    bound = 0
    for claim in read_claims():
        if claim.page == page:
            start, end = claim.locate(text)
            bound += len(pattern.findall(text[start:end]))
    return len(pattern.findall(text)), bound


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("do", nargs="?", choices=("list", "write"), default="list")
    given = parser.parse_args()
    try:
        claims = read_claims()
        if given.do == "write":
            for page in dict.fromkeys(claim.page for claim in claims):
                changed = write_page(page, [claim for claim in claims if claim.page == page])
                print(f"{page}: {changed} passages changed")
            return
        for claim in claims:
            since = count_commits_since(claim)
            age = "unknown to git" if since is None else f"{since} commits to its code since"
            print(f"{claim.name}\n    {claim.commit}, {age}; {claim.rests_on}\n    {claim.command}")
        drift = [found for claim in claims if (found := find_drift(claim))]
        if drift:
            raise FigureError("\n".join(["", *drift]))
        print("\ndecimal figures on a page, and those that a claim makes")
        for page in PAGES:
            every, bound = count_figures(page)
            print(f"{page!s:24}{every:5}{bound:5}")
    except FigureError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
