"""The docs site: built without warnings, links that resolve, nothing loaded from elsewhere."""

import importlib
import pkgutil
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from mover.pipeline.presets import PRESETS

DOCS = Path(__file__).parents[1] / "docs"
LOADS = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}


class Page(HTMLParser):
    """Names, links and loaded files of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.names: set[str] = {""}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.math = 0
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.names |= {given[key] or "" for key in ("id", "name") if key in given}
        self.math += tag == "math"
        if tag == "a" and given.get("href"):
            self.links.append(given["href"] or "")
        if tag in LOADS and given.get(LOADS[tag]):
            self.loads.append(given[LOADS[tag]] or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("sphinx", "furo", "myst_parser", "latex2mathml"):
        pytest.importorskip(package)
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    folders = ["-d", str(out / "trees"), str(DOCS), str(out / "html")]
    done = subprocess.run([*command, *folders], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return out / "html"


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob("*.html")}


@pytest.mark.slow
def test_links_inside_the_site_resolve(pages: dict[Path, Page]):
    broken = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or path.name in ("search.html", "genindex.html"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            missing = not target.exists()
            html = target.suffix == ".html" and not missing
            if missing or (html and unquote(parts.fragment) not in pages[target].names):
                broken.append(f"{path.name}: {link}")
    assert broken == []


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Page]):
    for path, page in pages.items():
        for load in page.loads:
            assert not urlsplit(load).scheme or load.startswith("data:"), f"{path.name}: {load}"
            assert not load.startswith("//"), f"{path.name}: {load}"
    for sheet in site.rglob("*.css"):
        found = re.findall(r"url\(\s*['\"]?(?!data:)(https?:|//)", sheet.read_text())
        imported = re.findall(r"@import[^;]*(https?:|//)", sheet.read_text())
        assert (found, imported) == ([], []), sheet.name


@pytest.mark.slow
def test_equations_are_drawn_by_the_browser(site: Path, pages: dict[Path, Page]):
    assert pages[site / "method.html"].math > 30
    for page in pages.values():
        assert not [load for load in page.loads if "mathjax" in load.lower()]


def test_the_weights_in_the_table_are_those_of_the_presets():
    row = next(
        line
        for line in (DOCS / "method.md").read_text().splitlines()
        if line.startswith("| weights")
    )
    columns = row.strip("| ").split("|")[1:]
    for text, name in zip(columns, ("paper", "robust"), strict=True):
        w = PRESETS[name].place.weights
        printed = [float(word.strip().replace("10⁵", "1e5")) for word in text.split(",")]
        assert printed == [w.bbox, w.silhouette, w.scale, w.depth, w.collision, w.contact]


def test_every_name_of_the_api_is_one_object_and_listed_once():
    named = re.findall(r"\.\. auto(\w+):: ([\w.]+)", (DOCS / "api.md").read_text())
    assert len(named) == len(set(named)) > 50
    for kind, name in named:
        assert kind == "module" or pkgutil.resolve_name(name) is not None
        assert kind != "module" or importlib.import_module(name)
