"""How often a silhouette leads home from bad starts: PYTHONPATH=src python benchmarks/reach.py.

Furniture starts with the noise model's largest errors: 30 cm along the ray with the size following,
30 degrees, 15 % along each axis, and, in a second set, a further quarter or half turn. The exact
gradient is compared with a far-reaching one, as the neural renderer has it (Kato, Ushiku, Harada,
Neural 3D Mesh Renderer, 2018, Sec. 3.1): each pixel whose colour is wrong pulls at each edge of the
outline in its row and its column with one over the distance.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx
from workload import CAMERA, FLOOR, furniture, seen, truth

from mover.core.observe import Energy
from mover.core.types import Layout, Objects
from mover.energy.config import Adam, BatchedBFGS, SceneWeights
from mover.energy.minimize import minimize
from mover.energy.objective import HumanCues
from mover.energy.terms.bbox import bbox_term
from mover.energy.terms.scale import scale_term
from mover.geometry.camera import outermost, project
from mover.geometry.placement import place_in, rest_on_support
from mover.geometry.raster import Topology, look
from mover.geometry.rotations import wrap
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_inputs import PlaceInputs
from mover.stages.objects.place_objects import place_objects
from mover.stages.objects.starts import alone, best_few, spread

LONG = Adam(300, 0.03, 0.002, beta2=0.98, keep_best=True)
SHORT = Adam(60, 0.03, 0.01, beta2=0.98, keep_best=True)
DESCENT = Adam(200, 0.03, 0.002, beta2=0.98, keep_best=True)
IMAGE = SceneWeights(1.0, 1.0, 0.3, 0.0, 0.0, 0.0)
TURN, SHIFT = math.radians(10), 0.1  # [m], a pose is right within these


class _Far(torch.autograd.Function):
    """Squared differences whose gradient reaches along rows and columns."""

    @staticmethod
    def forward(ctx: FunctionCtx, drawn: Tensor, mask: Tensor) -> Tensor:
        ctx.save_for_backward(drawn, mask)
        return (drawn - mask).square().sum((-2, -1))

    @staticmethod
    def backward(ctx: FunctionCtx, *grads: Tensor) -> tuple[Tensor, None]:
        drawn, mask = ctx.saved_tensors
        error = 2 * (drawn - mask)
        inside = drawn > 0.5
        pull = _scan(error, inside) + _scan(error.mT, inside.mT).mT
        return pull * grads[0][..., None, None], None


def _scan(error: Tensor, inside: Tensor) -> Tensor:
    """At each pixel beside an edge: wrong pixels of its row over their distance from it."""
    number = torch.arange(error.shape[-1])
    gap = number[:, None] - number  # [from, to]
    right = torch.where(gap >= 0, 1 / gap.abs().clamp_min(1), 0.0)  # `from` lies right of `to`
    bare, full = error * ~inside, error * inside
    rightward, leftward = bare @ right + full @ right.mT, bare @ right.mT + full @ right
    ends = inside[..., :-1] & ~inside[..., 1:]  # the object ends between these two
    begins = ~inside[..., :-1] & inside[..., 1:]
    zero = torch.zeros_like(inside[..., :1])
    at_end = torch.cat([ends, zero], -1) | torch.cat([zero, ends], -1)
    at_begin = torch.cat([begins, zero], -1) | torch.cat([zero, begins], -1)
    return rightward * at_end + leftward * at_begin


def energy(inputs: PlaceInputs, box: float, weight: float, far: bool) -> Callable[[Layout], Energy]:
    """The image's part of Eq. 1, robust form, with either gradient."""
    objects, image = inputs.objects, inputs.image
    area = image.masks.sum((-2, -1)).clamp_min(1)

    def of(layout: Layout) -> Energy:
        at = rest_on_support(layout, objects.supports, objects.size[:, 1], FLOOR)
        verts = place_in(objects.verts, at, CAMERA.R_cam_world)
        drawn, _ = look(verts, Topology(objects.faces, objects.edges), image.views, depth=False)
        price = _Far.apply if far else lambda d, m: (d - m).square().sum((-2, -1))
        pixels = project(outermost(verts, CAMERA.K), CAMERA.K)
        boxes = bbox_term(pixels, image.boxes, image.sides, 640.0, "robust")
        parts = {"silhouette": weight * price(drawn, image.masks) / area}
        parts["scale"] = 0.3 * scale_term(at.log_scale, "robust")
        return Energy(parts | ({"bbox": box * boxes} if box else {}))

    return of


def bad_starts(
    objects: Objects, there: Layout, flip: bool, rng: torch.Generator
) -> tuple[Objects, Layout]:
    """The furniture with wrong sizes, which the scale term keeps, and where it starts."""
    n = len(there.yaw)

    def sign(*size: int) -> Tensor:
        return torch.randint(2, size, generator=rng) * 2.0 - 1

    t = there.t_world_object
    far = 1 + 0.3 * sign(n) / t.norm(dim=-1)
    size = (1 + 0.15 * sign(n, 3)) * far[:, None]
    yaw = there.yaw + math.radians(30) * sign(n)
    if flip:
        yaw = yaw + math.pi / 2 * torch.randint(1, 4, (n,), generator=rng)
    place = torch.cat([t[:, :1] * far[:, None], t[:, 1:2], t[:, 2:] * far[:, None]], -1)
    wrong = replace(objects, verts=objects.verts * size[:, None], size=objects.size * size)
    return wrong, Layout(place, wrap(yaw), torch.zeros(n, 3))


def home(found: Layout, there: Layout, kinds: tuple[str, ...]) -> Tensor:
    """Whether each pose is right; a table looks the same from behind."""
    off = (found.t_world_object - there.t_world_object)[:, [0, 2]].norm(dim=-1)
    turn = wrap(found.yaw - there.yaw).abs()
    behind = torch.minimum(turn, math.pi - turn)
    same = torch.tensor([k == "table" for k in kinds])
    return (off < SHIFT) & (torch.where(same, behind, turn) < TURN)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=12)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng = torch.Generator().manual_seed(1)
    objects = furniture(args.objects, 2000, rng)
    there = truth(objects, rng)
    image, _ = seen(objects, there, 128)
    sets = [bad_starts(objects, there, flip, rng) for flip in (False, True)]
    print(f"{args.objects} objects; right within {SHIFT} m and 10 degrees: turned by 30 degrees,")
    print("by 30 degrees and a quarter or half turn; processor time of both [s]")

    def one(box: float, weight: float, far: bool) -> Callable[[PlaceInputs], Layout]:
        def run(inputs: PlaceInputs) -> Layout:
            found = minimize(energy(inputs, box, weight, far), inputs.starts, LONG).at
            return Layout(found.t_world_object[0], found.yaw[0], found.log_scale[0])

        return run

    def turned(inputs: PlaceInputs) -> Layout:
        far = energy(inputs, 1.0, 1.0, True)
        found = minimize(far, spread(inputs.starts, 8), SHORT)
        found = minimize(far, best_few(found.at, found.value, 3), DESCENT)
        best = best_few(found.at, found.value, 1)
        return Layout(best.t_world_object[0], best.yaw[0], best.log_scale[0])

    def many(config: PlaceConfig) -> Callable[[PlaceInputs], Layout]:
        return lambda inputs: place_objects(inputs, config).layout

    single = PlaceConfig(IMAGE, "robust", DESCENT)
    eight = replace(single, yaws=8, short=SHORT, num_hypotheses=3)
    fast = replace(
        eight,
        method=BatchedBFGS(),
        short=BatchedBFGS(steps=40, reach=0.2),
        coarse=2,
        perturbations=3,
    )
    rows = {
        "exact": one(0, 1.0, False),
        "exact, weight 10": one(0, 10.0, False),
        "far": one(0, 1.0, True),
        "exact + box": one(1.0, 1.0, False),
        "exact + box, weight 10": one(1.0, 10.0, False),
        "far + box": one(1.0, 1.0, True),
        "far + box, weight 0.1": one(1.0, 0.1, True),
        "far + box, 8 yaws": turned,
        "exact + box, Newton": many(replace(single, method=BatchedBFGS())),
        "exact + box, 8 yaws": many(eight),
        "exact + box, 8 yaws, Newton, fine": many(replace(fast, coarse=1, perturbations=0)),
        "exact + box, 8 yaws, Newton, 64 -> 128": many(replace(fast, perturbations=0)),
        "the same, shaken": many(fast),
    }
    for name, run in rows.items():
        begin, cells = time.process_time(), []
        for wrong, start in sets:
            inputs = PlaceInputs(wrong, CAMERA, FLOOR, image, HumanCues(), alone(start), start.yaw)
            found = home(run(inputs), there, objects.categories)
            cells.append(f"{int(found.sum()):>4}")
        print(f"{name:<42} {' '.join(cells)} {time.process_time() - begin:8.1f}", flush=True)


if __name__ == "__main__":
    main()
