"""Contacts of SMPL-X bodies from an official POSA checkpoint that the user has downloaded.

POSA (Hassan et al. 2021) guesses from the pose alone which vertices touch something. The network is
written from a description of its layers; neither weights nor meshes come with this package. It
works on coarse meshes (its folder mesh_ds) and learnt weights for "the third neighbour", so the
order of neighbours is part of its format: that in which OpenMesh links half-edges.

Departure: z = 0, the mean of the latent code, gives one answer; upstream draws z at random. The
bodies are turned by the true direction of gravity; upstream trusts the camera to be level.
"""

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import group_norm, linear

from mover.core.errors import InputError
from mover.core.files import BROKEN
from mover.core.pickles import load_weights
from mover.core.types import Bodies
from mover.geometry.rotations import axis_angle, rot_x

log = logging.getLogger(__name__)
LEVELS = (10475, 2619, 655)  # vertices of the full body and of the two coarser ones
LENGTH = 9  # vertices of a spiral
CODE = 256  # numbers of the latent code
GROUPS = 8  # of the normalisation
COUNTS = {1: (1_875_009, 153_665), 43: (1_923_435, 177_899)}
"""Numbers in the network and in its decoder, by the channels of the output."""
OFFICIAL = "b61f137d02a33c49f9d83ee651f0d60b1ddb80fc0c1e5b6aa85469f707238fb4"
"""Digest of the spirals of the official mesh_2, little-endian 64-bit numbers, row by row."""
DECODER = "decoder.de_spiral"
CHUNK = 32  # bodies decoded at once


def neighbours(faces: Int[np.ndarray, "faces 3"], count: int) -> tuple[list[list[int]], int]:
    """Neighbours of each vertex, clockwise, and how many triangles did not fit and were left out.

    About a vertex the triangles form fans, rows of neighbours of which each two next to one another
    have a triangle; the first fan begins at the stored half-edge.
    """
    fans: list[list[list[int]]] = [[] for _ in range(count)]
    taken, inner, left_out = set[tuple[int, int]](), set[int](), 0
    for a, b, c in faces.tolist():
        corners, sides = [(c, a, b), (a, b, c), (b, c, a)], {(a, b), (b, c), (c, a)}
        joined = [_joined(fans[v], into, out) for into, v, out in corners]
        if not all(joined) or inner & {a, b, c} or taken & sides:
            left_out += 1
            continue
        taken |= sides
        for (_, v, _), ring in zip(corners, joined, strict=True):
            if ring is fans[v]:
                inner.add(v)
            fans[v] = ring
    return [[n for fan in each for n in fan] for each in fans], left_out


def _joined(fans: list[list[int]], into: int, out: int) -> list[list[int]]:
    """The fans with one more triangle; the same where the last gap closes, none if it is odd."""
    end = next((fan for fan in fans if fan[-1] == into), None)
    start = next((fan for fan in fans if fan[0] == out), None)
    wider = [*(end or [into]), *(start or [out])]
    if end is None and start is None:
        return [*fans, wider]
    if end is start:
        return fans if len(fans) == 1 else []
    at = next(k for k, fan in enumerate(fans) if fan is (end or start))
    others = [fan for fan in (*fans[at + 1 :], *fans[:at]) if fan is not start]
    if end is None or (start and fans[0] is end):
        return [wider, *others]
    turn = others.index(fans[0]) if start and fans[0] is not start else 0
    return [*others[turn:], wider, *others[:turn]]


def spirals(
    verts: Float[np.ndarray, "verts 3"], faces: Int[np.ndarray, "faces 3"], length: int
) -> Int[np.ndarray, "verts length"]:
    """Each vertex, its ring of neighbours, the ring about that, and so on, cut at `length`.

    Where the rings end before that (or would, one ring on), the nearest vertices stand instead.
    """
    around, _ = neighbours(faces, len(verts))

    def ring_outside(last: list[int], row: list[int]) -> list[int]:  # each after one of the ring
        inner, taken, ring = set(last), {*last, *row}, dict[int, None]()
        for near in (around[vertex] for vertex in last):
            start = next((k for k, n in enumerate(near) if n in inner), len(near))
            ring |= dict.fromkeys(n for n in (*near[start:], *near[:start]) if n not in taken)
        return list(ring)

    rows: list[list[int]] = []
    for vertex in range(len(verts)):  # spirals differ in the number of their rings
        row, ahead = [vertex, *around[vertex]], ring_outside(around[vertex], [vertex])
        while ahead and len(row) + len(ahead) < length:
            row = [*row, *ahead]
            ahead = ring_outside(ahead, row)
        if not ahead:
            distance = np.square(verts - verts[vertex]).sum(-1)
            row = np.argsort(distance, kind="stable").tolist()
        rows.append([*row, *ahead][:length])
    return np.asarray(rows, dtype=np.int64)


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles in the order of the file; nothing is merged."""
    try:
        rows = [line.split() for line in path.read_text().splitlines()]
        verts = [[float(w) for w in row[1:4]] for row in rows if row[:1] == ["v"]]
        faces = [[int(w.split("/")[0]) - 1 for w in row[1:4]] for row in rows if row[:1] == ["f"]]
        return np.asarray(verts).reshape(-1, 3), np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    except BROKEN as error:
        raise InputError(f"{path}: cannot be read as a mesh ({error})") from error


def _sparse(path: Path, shape: tuple[int, int]) -> Tensor:
    """A matrix in scipy's file format."""
    from scipy import sparse

    try:
        matrix: Any = sparse.load_npz(path).tocoo()
    except BROKEN as error:
        raise InputError(f"{path}: cannot be read as a sparse matrix ({error})") from error
    if matrix.shape != shape:
        raise InputError(f"{path.name}: has the shape {matrix.shape}, expected {shape}")
    index = torch.from_numpy(np.stack([matrix.row, matrix.col]))
    values = torch.from_numpy(matrix.data.astype(np.float32))
    return torch.sparse_coo_tensor(index, values, shape, check_invariants=True).coalesce()


@dataclass(frozen=True)
class Posa:
    """A decoder and the meshes that it works on."""

    weights: dict[str, Tensor]  #: of the decoder
    spirals: Int[Tensor, "coarse 9"]
    down: tuple[Tensor, ...]  #: sparse matrices from the full body to coarser meshes, in order
    up: tuple[Tensor, ...]  #: sparse matrices back, in order
    channels: int  #: 1: contact; 43: contact and the kind of object


def load_posa(weights: Path, meshes: Path) -> Posa:
    """Read a checkpoint (contact.pt, contact_semantics.pt) and POSA's folder mesh_ds.

    Raises:
        InputError: If a file is missing, or is not what the published network needs.
    """
    state = load_weights(weights, "model_state_dict", "POSA's network")
    channels = len(state.get(f"{DECODER}.5.layer.weight", ()))
    if channels not in COUNTS:
        raise InputError(f"{weights.name}: no POSA network in it, expected '{DECODER}.5.layer'")
    decoder = {k: v for k, v in state.items() if k.startswith("decoder.")}
    found = sum(v.numel() for v in state.values()), sum(v.numel() for v in decoder.values())
    if found != COUNTS[channels]:
        raise InputError(
            f"{weights.name}: has {found[0]} numbers, {found[1]} of them in the decoder, "
            f"expected {COUNTS[channels][0]} and {COUNTS[channels][1]}"
        )
    verts, faces = _read_obj(meshes / "mesh_2.obj")
    full, middle, coarse = LEVELS
    if len(verts) != coarse:
        raise InputError(f"mesh_2.obj: has {len(verts)} vertices, expected {coarse}")
    index = spirals(verts, faces, LENGTH)
    digest = hashlib.sha256(np.ascontiguousarray(index, dtype="<i8").tobytes()).hexdigest()
    if digest != OFFICIAL:
        log.warning("%s: mesh_2.obj is not the official one: are the contacts right?", meshes)
    maps = {"D_1": (middle, full), "D_2": (coarse, middle), "U_2": (middle, coarse),
            "U_1": (full, middle)}  # fmt: skip
    d1, d2, u2, u1 = (_sparse(meshes / f"{name}.npz", shape) for name, shape in maps.items())
    return Posa(decoder, torch.from_numpy(index), (d1, d2), (u2, u1), channels)


@torch.no_grad()
def posa_contacts(
    posa: Posa, bodies: Bodies, samples: int = 0, seed: int = 0
) -> Float[Tensor, "bodies verts"]:
    """Chance that each vertex of SMPL-X bodies in the world (+y up) touches something.

    It is the mean over so many random latent codes; with 0 `samples` of the mean code alone.

    Raises:
        InputError: If these are no SMPL-X bodies with a pose.
        ValueError: If they are not in the world.
    """
    if bodies.space != "world":
        raise ValueError(f"posa_contacts: bodies are in space '{bodies.space}', expected 'world'")
    if bodies.verts.shape[1] != LEVELS[0]:
        found = bodies.verts.shape[1]
        raise InputError(f"bodies: {found} vertices, POSA expects {LEVELS[0]} (SMPL-X)")
    if bodies.pose is None or bodies.joints is None:
        raise InputError("bodies: POSA needs SMPL-X parameters and joints, found meshes only")
    noise = np.random.default_rng(seed).standard_normal((max(samples, 1), CODE))
    codes = torch.from_numpy(noise).float() * float(samples > 0)
    still = canonical(bodies.verts, bodies.joints[:, 0], axis_angle(bodies.pose.global_orient))
    chances: list[Tensor] = []
    for part in still.float().split(CHUNK):
        coarse = _through(posa.down, part)
        chance = torch.stack([decode(posa, coarse, z)[..., :1] for z in codes]).mean(0)
        chances.append(_through(posa.up, chance)[..., 0].clamp(0, 1))
    return torch.cat(chances)


def canonical(
    verts: Float[Tensor, "bodies verts 3"],
    pelvis: Float[Tensor, "bodies 3"],
    turn: Float[Tensor, "bodies 3 3"],
) -> Float[Tensor, "bodies verts 3"]:
    """World vertices [m] about the pelvis without heading and roll: x left, y down, z back."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).to(verts)
    root = flip @ turn.to(verts)
    tilt = rot_x(torch.atan2(-root[:, 1, 2], root[:, 1, 1]))
    return (verts - pelvis[:, None]) @ flip.mT @ (tilt @ root.mT).mT


def decode(
    posa: Posa, coarse: Float[Tensor, "bodies coarse 3"], code: Float[Tensor, " code"]
) -> Float[Tensor, "bodies coarse channels"]:
    """Contact (a chance) and, if the network has them, scores of the kinds of objects."""

    def of(name: str) -> tuple[Tensor, Tensor]:
        return posa.weights[f"{DECODER}.{name}.weight"], posa.weights[f"{DECODER}.{name}.bias"]

    x = torch.cat([coarse, code.expand(*coarse.shape[:2], -1)], -1)
    for layer in range(5):
        x = x[:, posa.spirals].flatten(2) if layer > 1 else x
        x = linear(x, *of(f"{layer}.conv.layer"))
        x = group_norm(x.mT, GROUPS, *of(f"{layer}.norm")).mT.relu()
    x = linear(x[:, posa.spirals].flatten(2), *of("5.layer"))
    return torch.cat([x[..., :1].sigmoid(), x[..., 1:]], -1)


def _through(maps: tuple[Tensor, ...], x: Float[Tensor, "b v c"]) -> Float[Tensor, "b w c"]:
    """Apply sparse matrices to the vertices, one after another."""
    for matrix in maps:
        flat = x.transpose(0, 1).reshape(x.shape[1], -1)
        x = torch.sparse.mm(matrix, flat).reshape(-1, x.shape[0], x.shape[2]).transpose(0, 1)
    return x
