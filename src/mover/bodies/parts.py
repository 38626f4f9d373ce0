"""Parts of a body that touch things: soles, seat, thighs, back, palms, forearms.

Of a skinned body they follow from the weights and from normals and heights in the zero pose; for
MHR's topology their indices are an asset (made by `tools/body_parts`). Other meshes, as SMPL's
where its model files are not there, are matched to the open body (`match_mesh`).
"""

import hashlib
import logging

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.limbs import landmark_rings, thin
from mover.bodies.match_mesh import Matched, match
from mover.bodies.skin import PARTS, lowest_soles, model_parts
from mover.bodies.skinning import ASSETS, SkinnedBody, open_body
from mover.bodies.smpl_files import KINDS, load_smpl
from mover.bodies.smpl_model import skin_of_model
from mover.core.errors import InputError
from mover.core.records import fingerprint, record
from mover.core.types import Bodies

Array = np.ndarray
log = logging.getLogger(__name__)

POSES = 4
"""Poses that vote on the parts of an unknown mesh."""
MOST_MATCHES = 16
_matches: dict[str, Matched | None] = {}


@record
class BodyParts:
    """Which part of the body each vertex belongs to."""

    part_of: Int[Tensor, " verts"]
    """Index into `PARTS`; -1: none."""
    rings: Int[Tensor, "landmarks members"]
    """Vertices around each of `LANDMARKS`: their mean is about where the joint is. Empty where the
    mesh could not be matched to a human body."""


def members(parts: BodyParts, *names: str) -> Bool[Tensor, " verts"]:
    """Which vertices belong to one of these parts."""
    wanted = torch.tensor([PARTS.index(n) for n in names], device=parts.part_of.device)
    return torch.isin(parts.part_of, wanted)


def parts_of(bodies: Bodies, up_cam: Float[Tensor, "3"] | None = None) -> BodyParts:
    """Parts of these bodies: by the model's skin or lists where it is known, else by geometry.

    Args:
        bodies: People with one topology, in any poses.
        up_cam: Direction of up in the frame of `bodies`; a level camera or +y of the world if not
            given. Asked only of a mesh that cannot be matched to a human body: its soles are what
            lies lowest.
    """
    found = _find(bodies, up_cam)
    device = bodies.verts.device
    return BodyParts(found.part_of.to(device), found.rings.to(device))


def _find(bodies: Bodies, up_cam: Float[Tensor, "3"] | None) -> BodyParts:
    model = known_model(bodies.faces, bodies.verts.shape[1]) or _users_model(bodies)
    if model is not None:
        rings = thin(model.verts.numpy(), landmark_rings(model))
        return BodyParts(model_parts(model), torch.from_numpy(rings))
    listed = _listed(bodies)
    if listed is not None:
        return listed
    none = torch.zeros((0, 0), dtype=torch.long)
    if len(bodies.verts) == 0:
        return BodyParts(torch.full((bodies.verts.shape[1],), -1), none)
    rows = torch.linspace(0, len(bodies.verts) - 1, POSES).round().long().unique()
    meshes, faces = bodies.verts[rows].detach().cpu().double(), bodies.faces.detach().cpu()
    found = _matched(meshes, faces)
    if found is not None:
        return BodyParts(torch.from_numpy(found.part), torch.from_numpy(found.rings))
    log.warning("the bodies' mesh does not look like a whole person: only its soles are looked for")
    default = (0.0, -1.0, 0.0) if bodies.space == "camera" else (0.0, 1.0, 0.0)
    up = torch.tensor(default) if up_cam is None else up_cam.detach().cpu()
    return BodyParts(lowest_soles(meshes, faces, up.to(meshes)), none)


def _matched(
    meshes: Float[Tensor, "meshes verts 3"], faces: Int[Tensor, "faces 3"]
) -> Matched | None:
    """`match`, once for the same poses of one capture."""
    key = fingerprint(meshes, faces)
    if key not in _matches:
        while len(_matches) >= MOST_MATCHES:
            _matches.pop(next(iter(_matches)), None)
        _matches[key] = match(meshes.numpy(), faces.numpy())
    return _matches[key]


def known_model(faces: Int[Tensor, "faces 3"], verts: int) -> SkinnedBody | None:
    """The shipped body with exactly this topology, if there is one."""
    for model in (open_body("small"), open_body("full")):
        if model.verts.shape[0] == verts and torch.equal(model.faces, faces.cpu()):
            return model
    return None


def _users_model(bodies: Bodies) -> SkinnedBody | None:
    """The skin of the user's licensed model, where its files are there and fit these bodies."""
    named = [] if bodies.pose is None else [(bodies.pose.model, bodies.pose.gender)]
    count = bodies.verts.shape[1]
    for name, gender in [*named, *((n, "neutral") for n, k in KINDS.items() if k.verts == count)]:
        try:
            skin = skin_of_model(load_smpl(name, gender)) if name in KINDS else None
        except InputError:
            continue
        if skin is not None and torch.equal(skin.faces, bodies.faces.cpu()):
            return skin
    return None


def digest_of(faces: Int[Array, "faces 3"]) -> str:
    """What distinguishes one topology from others."""
    return hashlib.sha256(np.ascontiguousarray(faces, dtype="<i8").tobytes()).hexdigest()


def _listed(bodies: Bodies) -> BodyParts | None:
    """The parts of MHR, the body of SAM 3D Body, if this is its topology."""
    with np.load(ASSETS / "mhr_parts.npz") as data:
        part_of, rings, digest = data["part_of"], data["rings"], str(data["digest"])
    if bodies.verts.shape[1] != len(part_of) or digest_of(bodies.faces.cpu().numpy()) != digest:
        return None
    return BodyParts(torch.from_numpy(part_of).long(), torch.from_numpy(rings).long())
