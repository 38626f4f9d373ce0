"""Names of nodes and files as categories and ids."""

import re
from collections.abc import Container

from .parts import UNKNOWN

SAFE = re.compile(r"[^\w.-]+")


def category_of_name(name: str) -> str:
    """`dining table` of dining_table_2, 3_dining_table, `Dining Table.001`."""
    words = re.sub(r"[_\-.]+", " ", name).split()
    plain = [w for w in words if not w.isdecimal() and w.lower() not in ("mesh", "geometry")]
    return " ".join(plain) or UNKNOWN


def free_id(category: str, name: str, used: Container[str]) -> str:
    """An id that scene.json takes: of the name, else of the category and a number."""
    plain = SAFE.sub("_", name).strip("._- ")
    if not plain or plain.isdecimal():
        plain = f"{SAFE.sub('_', category).strip('._- ') or UNKNOWN}_{plain or 0}"
    if plain.casefold() in ("ground", "free"):
        plain = f"{plain}_0"
    plain, number = plain[:80], 1
    taken = plain
    while taken in used:
        taken, number = f"{plain}_{number}", number + 1
    return taken
