"""Errors like those of real upstream tools, on a room in which everything is known.

Sources: the paper's sensitivity table (uniform noise on the translation, orientation and scale of
Total3D's objects: 0.3 m, 30 degrees, 15 %), and published errors of monocular body regression
(a few degrees a joint and 2-3 % in depth, both slow in time); the other rows name their own
sources in `NoiseConfig`. Every part has its own stream of
random numbers, so that changing one leaves the others as they were.
"""

import dataclasses

import numpy as np
import torch

from ..furniture import Furniture
from ..geometry.camera import pitch_roll, tilted
from ..geometry.rotations import rot_y
from ..types import Camera, Capture, Piece, Scene
from .known import KnownRoom
from .noise_config import NoiseConfig
from .noise_finds import noisy_finds
from .noise_masks import leaking, noisy_detections, noisy_people
from .noise_meshes import broken, other_shapes
from .noise_people import lose_feet, noisy_bodies
from .threads import one_thread


@one_thread()
def add_noise(room: KnownRoom, noise: NoiseConfig, seed: int) -> Capture:
    """What upstream tools would say about a room; the same for the same seed on every machine.

    The guess of the camera is wrong, so the objects are given in a wrong world: they keep their
    box centres in the camera frame, and their fronts are projected onto its horizontal plane.
    """
    streams = [np.random.default_rng([seed, k]) for k in range(9)]
    camera = _noisy_camera(room.truth.camera, noise, streams[0])
    pieces = tuple(
        _noisy_piece((piece, furniture), (room.truth.camera, camera), noise, streams[1])
        for piece, furniture in zip(room.truth.pieces, room.furniture, strict=True)
    )
    pieces = broken(other_shapes(pieces, room.furniture, noise, streams[2]), noise, streams[6])
    detections = noisy_detections(room.capture.detections, noise.object_masks, streams[3])
    capture = dataclasses.replace(
        room.capture,
        scene=Scene(camera, None, pieces),
        detections=leaking(detections, noise.leaks, streams[7]),
        bodies=lose_feet(noisy_bodies(room, noise, streams[4]), noise, streams[8]),
        people=noisy_people(
            room.capture.people, noise.person_masks, noise.missed_masks, streams[5]
        ),
    )
    assert room.truth.ground is not None, "a known room has a floor"
    return noisy_finds(capture, room.truth.ground, noise, [seed, 9])


def _noisy_camera(camera: Camera, noise: NoiseConfig, rng: np.random.Generator) -> Camera:
    pitch, roll = pitch_roll(camera.R_cam_world.double())
    error = np.radians(noise.camera) * rng.uniform(2 / 3, 4 / 3, 2) * rng.choice([-1.0, 1.0], 2)
    zoom = 1 + noise.focal * float(rng.uniform(-1, 1))
    K = camera.K * torch.tensor([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
    R = tilted(pitch + float(error[0]), roll + float(error[1])).float()
    return Camera(K, R, camera.width, camera.height)


def _noisy_piece(
    known: tuple[Piece, Furniture],
    cameras: tuple[Camera, Camera],
    noise: NoiseConfig,
    rng: np.random.Generator,
) -> Piece:
    """The piece in the world of the wrong camera, moved, turned and stretched."""
    piece, _ = known
    turn = cameras[1].R_cam_world.double().mT @ cameras[0].R_cam_world.double()
    low, high = piece.mesh.verts.amin(0).double(), piece.mesh.verts.amax(0).double()
    middle = (low + high) / 2 * piece.scale.double()
    yaw = piece.yaw.double()
    centre = turn @ (rot_y(yaw) @ middle + piece.t_world_object.double())
    front = turn @ torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
    far = 1 + noise.along_ray * float(rng.uniform(-1, 1)) / float(centre.norm())
    aside = torch.from_numpy(noise.sideways * rng.uniform(-1, 1, 3))
    size = piece.scale.double() * far * torch.from_numpy(1 + noise.scale * rng.uniform(-1, 1, 3))
    wrong = np.radians(noise.yaw) * float(rng.uniform(-1, 1))
    quarter = float(rng.integers(1, 4)) if float(rng.uniform()) < noise.flips else 0.0
    angle = torch.atan2(front[0], front[2]) + wrong + quarter * np.pi / 2
    angle = torch.atan2(angle.sin(), angle.cos())
    place = centre * far + aside - rot_y(angle) @ ((low + high) / 2 * size)
    return dataclasses.replace(
        piece, t_world_object=place.float(), yaw=angle.float(), scale=size.float()
    )
