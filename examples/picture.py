"""Draw the picture of the README from the demo's folder: python examples/picture.py demo OUT.jpg.

The given scene on the left, the result on the right, each with the people as they are in it.
"""

import sys
from pathlib import Path

import torch

from mover.app.pictures.overlay import draw_picture, furniture, joined, people
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read

SHOWN = (0.19, 0.38, 0.83)  # where in the video: on the chair, on the sofa, on the bed


def main(demo: Path, picture: Path) -> None:
    """Draw and save."""
    from PIL import Image

    capture, result = read("folder", demo / "capture"), read_scene(demo / "room" / "scene.json")
    before = read_bodies(demo / "room" / "initial_bodies.npz")
    after = read_bodies(demo / "room" / "bodies.npz")
    columns = [
        torch.cat([
            draw_picture(
                joined([furniture(scene), people(b, [int(k * len(b.frame))])]),
                scene.camera, capture.reference, scene.ground,
            )[0]
            for k in SHOWN
        ])
        for scene, b in ((capture.scene, before), (result, after))
    ]  # fmt: skip
    image = Image.fromarray((torch.cat(columns, 1).clamp(0, 1) * 255).byte().numpy())
    image.resize((image.width // 2, image.height // 2), Image.Resampling.LANCZOS).save(
        picture, quality=88
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
