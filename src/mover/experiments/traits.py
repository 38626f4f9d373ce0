"""What each true object of a room is like: used by people or not, hidden or seen."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.camera import to_camera
from ..geometry.placement import place_piece
from ..geometry.raster import first_hit
from ..geometry.rotations import wrap
from ..records import record
from ..rooms import KnownRoom
from ..types import Camera, Piece, Scene

WIDTH = 480  # [px] of the picture in which hidden shares are counted
BORDER = 3  # the wider picture is so many images wide and high
FLIPPED = math.radians(60)  # [rad]
PAUSE = 1.0  # [s]


@record
class Traits:
    """An object of the truth, for the rows of the tables."""

    id: str
    category: str
    touched: bool
    """People sit or lie on it, lean on it or lay a hand on it."""
    hidden: float
    """Share of what the image would show of it that other furniture hides; 1: all."""
    truncated: float = 0.0
    """Share of its picture that the border of the image cuts off; 1: all."""
    flipped: bool = False
    """The initial guess of its yaw is wrong by more than `FLIPPED`; false where there is none."""
    stays: int = 0
    """How often people use it: stretches of touch, with a second or more without between them."""


def traits_of(room: KnownRoom, initial: Scene) -> tuple[Traits, ...]:
    """What each object of a known room is, who uses it, and how well it is seen and guessed."""
    used = set(room.touched.unique().tolist())
    hidden, cut = hidden_shares(room.truth), truncated_shares(room.truth)
    guesses = {piece.id: piece for piece in initial.pieces}
    return tuple(
        Traits(
            piece.id,
            piece.category,
            index in used,
            hidden[index],
            cut[index],
            is_flipped(piece, guesses.get(piece.id)),
            stays_at(room, index),
        )
        for index, piece in enumerate(room.truth.pieces)
    )


def is_flipped(truth: Piece, guess: Piece | None) -> bool:
    """Whether a guess looks another way."""
    return guess is not None and float(wrap(guess.yaw - truth.yaw).abs()) > FLIPPED


def stays_at(room: KnownRoom, index: int) -> int:
    """How often people come to touch an object, each person for themselves."""
    bodies = room.bodies
    pause = PAUSE * (bodies.fps or 1.0)
    touching = (room.touched == index).any(1)
    count = 0
    for person in bodies.person.unique():
        frames = bodies.frame[touching & (bodies.person == person)].sort().values
        count += min(len(frames), 1) + int((frames.diff() > pause).sum())
    return count


def truncated_shares(scene: Scene) -> tuple[float, ...]:
    """Share of each object's pixels, seen alone in a wider picture, that are not in the image."""
    camera = scene.camera
    zoom = WIDTH / BORDER / camera.width
    height, width = (max(1, round(zoom * side)) for side in (camera.height, camera.width))
    size = (BORDER * height, BORDER * width)
    top, left = (BORDER - 1) * height // 2, (BORDER - 1) * width // 2
    smaller = torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    aside = torch.tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    K = camera.K * smaller + aside
    shares: list[float] = []
    for piece in scene.pieces:  # meshes differ in their number of triangles
        seen = _depth(piece, camera, K, size).isfinite()
        inside = int(seen[top : top + height, left : left + width].sum())
        shares.append(round(1 - inside / max(1, int(seen.sum())), 4))
    return tuple(shares)


def hidden_shares(scene: Scene) -> tuple[float, ...]:
    """Share of each object's pixels within the image that other objects hide."""
    alone = torch.stack(_depths(scene)) if scene.pieces else torch.zeros(0, 1, 1)
    covered = alone.isfinite()
    seen = covered & (alone <= alone.amin(0, keepdim=True)) if len(alone) else covered
    whole, left = covered.sum((1, 2)), seen.sum((1, 2))
    shares = torch.where(whole > 0, 1 - left / whole.clamp_min(1), torch.ones_like(whole).float())
    return tuple(round(share, 4) for share in shares.tolist())


def _depths(scene: Scene) -> list[Float[Tensor, "h w"]]:
    """Depth of each object drawn alone in a small picture [m], inf where it is not."""
    camera = scene.camera
    zoom = min(1.0, WIDTH / camera.width)
    size = (max(1, round(camera.height * zoom)), max(1, round(camera.width * zoom)))
    zooms = torch.tensor([size[1] / camera.width, size[0] / camera.height, 1.0]).to(camera.K)
    return [_depth(piece, camera, camera.K * zooms[:, None], size) for piece in scene.pieces]


def _depth(
    piece: Piece, camera: Camera, K: Float[Tensor, "3 3"], size: tuple[int, int]
) -> Float[Tensor, "h w"]:
    """Depth of an object drawn alone [m], inf where it is not."""
    mesh = place_piece(piece)
    verts = to_camera(mesh.verts.to(camera.K), camera.R_cam_world)
    return first_hit(verts, mesh.faces, K, size)[0]
