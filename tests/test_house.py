"""The size and the language of the project: limits that only shrink, and rules of style.

A change that needs more than a limit allows says what it takes away; a change that needs less sets
the limit to what is left (`python tests/test_house.py` prints all numbers).
"""

import ast
import re
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest
import torch
from beartype.roar import BeartypeCallHintViolation

from mover.geometry.boxes import iou2d

HOME = Path(__file__).parents[1]
LINES = {
    "src/mover/app": 4_444,
    "src/mover/bodies": 1_947,
    "src/mover/core": 1_566,
    "src/mover/energy": 3_861,
    "src/mover/evaluate": 986,
    "src/mover/extensions": 1_223,
    "src/mover/fitting": 1_977,
    "src/mover/furniture": 946,
    "src/mover/geometry": 3_440,
    "src/mover/io": 11_150,
    "src/mover/perceive": 2_947,
    "src/mover/pipeline": 1_263,
    "src/mover/stages": 6_172,
    "bench": 7_452,
    "benchmarks": 1_429,
    "tests": 30_767,
}
FILES = {"src/mover": 213, "bench": 32}
LIMITS = {
    "words in code": 0,
    "words in pages": 0,
    "class names with two meanings": 0,
    "small helpers": 53,
    "modules in circles": 0,
}  # fmt: skip
WORDS = {
    "price": "cost", "prices": "costs", "priced": "weighted, evaluated",
    "pricing": "cost, weights", "told": "observed, given by, estimated from",
    "tells": "constrains, determines", "doubt": "uncertainty, prior weight",
    "doubts": "uncertainties", "doubted": "down-weighted", "believed": "weighted, trusted",
    "believe": "weight, trust", "heard": "used", "voice": "observation, vote",
    "voices": "observations", "alike": "similar, duplicate", "begun": "started",
    "anew": "again", "crew": "workers", "whoever": "the person", "nobody": "no person",
}  # fmt: skip
"""Words of our own, and what the field says."""
PHRASES = (
    r"\bwho (lies|sits|stands|is seated|lay)\b",
    r"\bwhat (lies|carries|hides) (it|them|who)\b",
)
PLAIN = re.compile(rf"(?<![a-z_])(?:{'|'.join(WORDS)})(?![a-z_])")
IN_A_NAME = re.compile(rf"(?<=_)(?:{'|'.join(WORDS)})\b|\b(?:{'|'.join(WORDS)})(?=_)")
PHRASE = re.compile("|".join(f"(?:{phrase})" for phrase in PHRASES))
RANDOM = {"rand", "randn", "randint", "randperm", "normal", "multinomial"}
SMALL = 6  # lines of the body of a helper that is better written where it is called


def python(*folders: str) -> list[Path]:
    """All files of Python below some folders of the project."""
    return [path for folder in folders for path in sorted((HOME / folder).rglob("*.py"))]


def lines_of(paths: Iterable[Path]) -> int:
    """Lines of all files together."""
    return sum(path.read_text(encoding="utf-8").count("\n") for path in paths)


def words_of(paths: Iterable[Path]) -> Counter[str]:
    """How often each file has words that are none of the field's."""
    found: Counter[str] = Counter()
    for path in paths:
        text = path.read_text(encoding="utf-8").lower()
        name = str(path.relative_to(HOME))
        found[name] += sum(len(pattern.findall(text)) for pattern in (PLAIN, IN_A_NAME, PHRASE))
    return +found


@cache
def trees(folder: str = "src/mover") -> dict[Path, ast.Module]:
    """The syntax of each file of the program, or of another folder."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in python(folder)}


def class_names_with_two_meanings() -> list[str]:
    """Class names, without leading underscores, that the program has twice."""
    names = Counter(
        node.name.lstrip("_")
        for tree in trees().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )
    return sorted(name for name, count in names.items() if count > 1)


def small_helpers() -> list[str]:
    """Private functions of fewer than `SMALL` lines, without docstring, with one caller."""
    found: list[str] = []
    for path, tree in trees().items():
        used = Counter(node.id for node in ast.walk(tree) if isinstance(node, ast.Name))
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef) or not re.match("_[^_]", node.name):
                continue
            body = node.body[1:] if ast.get_docstring(node) else node.body
            size = sum((part.end_lineno or part.lineno) - part.lineno + 1 for part in body)
            if size < SMALL and used[node.name] == 1:
                found.append(f"{path.relative_to(HOME)}: {node.name}")
    return found


def modules_in_circles() -> list[str]:
    """Modules of the program that import themselves through others when they are loaded."""
    known = {
        ".".join(path.relative_to(HOME / "src").with_suffix("").parts).removesuffix(".__init__"): (
            tree
        )
        for path, tree in trees().items()
    }
    imports: dict[str, set[str]] = {}
    for name, tree in known.items():
        wanted: set[str] = set()
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                wanted |= {node.module, *(f"{node.module}.{part.name}" for part in node.names)}
            elif isinstance(node, ast.Import):
                wanted |= {part.name for part in node.names}
        imports[name] = (wanted & known.keys()) - {name}
    reached = {name: set(targets) for name, targets in imports.items()}
    while True:  # until nothing more is reached
        more = {n: t.union(*(reached[m] for m in t)) if t else t for n, t in reached.items()}
        if more == reached:
            return sorted(name for name, targets in reached.items() if name in targets)
        reached = more


def pages() -> list[Path]:
    """The pages of the documentation."""
    return [*sorted((HOME / "docs").glob("*.md")), HOME / "README.md"]


def measured() -> dict[str, int]:
    """What the limits hold."""
    return {
        "words in code": words_of(python("src/mover", "bench", "benchmarks")).total(),
        "words in pages": words_of(pages()).total(),
        "class names with two meanings": len(class_names_with_two_meanings()),
        "small helpers": len(small_helpers()),
        "modules in circles": len(modules_in_circles()),
    }


def folders() -> list[str]:
    """The packages of the program, and what stands beside it."""
    packages = sorted(path.parent for path in (HOME / "src" / "mover").glob("*/__init__.py"))
    return [*(str(p.relative_to(HOME)) for p in packages), "bench", "benchmarks", "tests"]


def test_every_package_has_a_budget() -> None:
    assert sorted(LINES) == sorted(folders())


@pytest.mark.parametrize(("folder", "most"), LINES.items())
def test_packages_keep_to_their_lines(folder: str, most: int) -> None:
    assert lines_of(python(folder)) <= most


@pytest.mark.parametrize(("folder", "most"), FILES.items())
def test_the_program_and_the_bench_keep_to_their_files(folder: str, most: int) -> None:
    assert len(python(folder)) <= most


def test_code_has_the_words_of_the_field() -> None:
    found = words_of(python("src/mover", "bench", "benchmarks"))
    assert found.total() <= LIMITS["words in code"], found


def test_pages_have_the_words_of_the_field() -> None:
    found = words_of(pages())
    assert found.total() <= LIMITS["words in pages"], found


@pytest.mark.parametrize(
    "check", [class_names_with_two_meanings, small_helpers, modules_in_circles]
)
def test_what_reads_badly_becomes_no_more(check) -> None:
    found = check()
    assert len(found) <= LIMITS[check.__name__.replace("_", " ")], found


def test_files_and_functions_are_short() -> None:
    long = [path for path in python("src/mover", "bench") if path.read_text().count("\n") > 500]
    for path, tree in (trees() | trees("bench")).items():
        for node in ast.walk(tree):
            is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            if is_function and node.end_lineno - node.lineno >= 60:
                long.append(path / node.name)
    assert not long


def test_shape_checks_stay_alive() -> None:
    late = "from __future__ import annotations"
    assert not [p for p in python("src/mover", "bench") if late in p.read_text()]
    iou2d(torch.zeros(3, 4), torch.zeros(3, 4))
    for other in (torch.zeros(2, 4), torch.zeros(3, 4).long(), None):
        with pytest.raises(BeartypeCallHintViolation):
            iou2d(torch.zeros(3, 4), other)


def test_no_device_and_no_hidden_randomness_is_named() -> None:
    wrong = []
    nodes = ((path, node) for path, tree in (trees() | trees("bench")).items()
             for node in ast.walk(tree) if isinstance(node, ast.Call))  # fmt: skip
    for path, call in nodes:
        name = ast.unparse(call.func)
        hidden = name.split(".")[0] == "torch" and name.split(".")[-1] in RANDOM
        if hidden and "generator" not in {k.arg for k in call.keywords}:
            wrong.append((path, name))
        if name.endswith(".cuda") or "set_default" in name:
            wrong.append((path, name))
    assert not wrong


def test_the_root_holds_packages_and_each_says_what_it_is() -> None:
    for root in (HOME / "src" / "mover", HOME / "bench" / "mover_bench"):
        assert {p.name for p in root.glob("*.py")} <= {"__init__.py", "__main__.py"}
        folders = [p for p in root.iterdir() if p.is_dir() and any(p.glob("*.py"))]
        assert len(folders) <= 13
        assert all(ast.get_docstring(ast.parse((p / "__init__.py").read_text())) for p in folders)


def test_nothing_of_the_program_needs_the_bench_but_the_tables_of_commands_and_formats() -> None:
    root = HOME / "src" / "mover"
    named = {p for p in root.glob("**/*.py") if "mover_bench" in p.read_text()}
    assert named == {root / "app" / "cli" / "__init__.py", root / "io" / "formats.py"}


if __name__ == "__main__":  # the numbers, to set the limits to
    print({folder: lines_of(python(folder)) for folder in folders()})  # noqa: T201
    print({folder: len(python(folder)) for folder in FILES})  # noqa: T201
    print(measured(), modules_in_circles(), class_names_with_two_meanings())  # noqa: T201
