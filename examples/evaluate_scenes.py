"""How far two scenes are from the truth: python examples/evaluate_scenes.py."""

import dataclasses

import numpy as np
import torch

from mover.core.types import Camera, Scene, SceneObject
from mover.evaluate.evaluation import evaluate, table
from mover.furniture.library import make_piece
from mover.geometry.camera import tilted


def make_truth() -> Scene:
    """A table and a chair, two metres and a half before the camera."""
    K = torch.tensor([[250.0, 0, 160], [0, 250, 120], [0, 0, 1]])
    camera = Camera(K, tilted(torch.tensor(-0.2), torch.tensor(0.0)), 320, 240)
    pieces = tuple(
        SceneObject(
            id=f"{name}_0",
            category=name,
            mesh=make_piece(name, np.random.default_rng(0), style=0).mesh,
            mesh_file="",
            annotation=None,
            support="ground",
            t_world_object=torch.tensor(place),
            yaw=torch.tensor(0.4),
            scale=torch.ones(3),
        )
        for name, place in (("table", (0.4, -1.4, -3.2)), ("chair", (-0.7, -1.4, -2.6)))
    )
    return Scene(camera, -1.4, pieces)


def shifted(scene: Scene, by: float) -> Scene:
    """The same scene with its objects a little off [m]."""
    off = torch.tensor([by, 0.0, -by])
    pieces = tuple(
        dataclasses.replace(p, t_world_object=p.t_world_object + off) for p in scene.objects
    )
    return dataclasses.replace(scene, objects=pieces)


def main() -> dict:
    """A bad guess, a better one, and the truth."""
    truth = make_truth()
    metrics = evaluate(shifted(truth, 0.25), shifted(truth, 0.05), truth)
    print(table(metrics))
    return metrics


if __name__ == "__main__":
    main()
