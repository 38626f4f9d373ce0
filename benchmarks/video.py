"""From a video to a room, on known rooms: what each step costs and what comes out.

Each room is drawn as an MP4 and goes the whole way of `mover video`; for the networks stand the
truth with the errors of detectors (`mover_bench.rooms.seen`), under COCO's classes. Furniture that
COCO has no class for is not found and not counted. With --other-designs no piece of the room's
designs is among the shapes that the first scene is made of: no mesh is the true one.

With --height the heights of all people are given.

    python benchmarks/video.py --seeds 100-103 --other-designs --out video
    python benchmarks/video.py --seeds 100-102 --other-designs --depth depth disparity --out video
"""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fit import Errors, errors_by_posture, heights_in, lines_of_postures, misses
from layout import other_designs

from mover.app.cli.run import reconstruct_into
from mover.app.cli.video import VideoArgs, video_to_room
from mover.app.pictures.film import save_film
from mover.app.results import Origin
from mover.bodies.corrected import in_world
from mover.core.types import Scene
from mover.evaluate.bodies import shared_rows
from mover.evaluate.evaluation import EvaluatedBodies, evaluate
from mover.evaluate.scene import SIDES
from mover.furniture.library import canonical, meanings
from mover.geometry.camera import to_camera, to_world
from mover.geometry.placement import place_object
from mover.geometry.raster import Crops, Topology, look
from mover.geometry.rle import decode
from mover.geometry.topology import edges_of
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.camera_file import camera_to_json
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.io.files.fields import write_json
from mover.pipeline.presets import PRESETS
from mover_bench.rooms.config import NoiseConfig, RoomConfig, parse_seeds
from mover_bench.rooms.known import KnownRoom, draw_frame, make_room
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.seen import COCO, Seen

FPS = 5.0
KINDS = ("depth", "disparity")
KEYS = ("iou3d", "p2s", "center_error", "contact_f1", "pje", "p_pje")


def truth_of(room: KnownRoom, capture: Path) -> dict[str, int]:
    """Which true object each object of the first scene stands for: the best overlap of masks."""
    found = read_capture(capture)
    true = [decode(d.mask, 0) if d.mask else None for d in room.capture.detections]
    masks = {d.id: d.mask for d in found.detections}
    names: dict[str, int] = {}
    for piece in found.scene.objects:
        mask = None if piece.annotation is None else masks[piece.annotation]
        assert mask is not None, "a first scene is made from masks"
        shared = [0 if t is None else int((decode(mask, 0) & t).sum()) for t in true]
        names[piece.id] = int(np.argmax(shared))
    return names


def renamed(scene: Scene, room: KnownRoom, names: dict[str, int]) -> Scene:
    """The scene under the truth's names; of two that stand for one object the first counts."""
    true, taken = room.truth.objects, dict[int, str]()
    for name, index in names.items():
        taken.setdefault(index, name)
    keep = {name: true[index].id for index, name in taken.items()}
    return replace(
        scene, objects=tuple(replace(p, id=keep[p.id]) for p in scene.objects if p.id in keep)
    )


def measured(room: KnownRoom, seed: int, kind: str, capture: Path) -> None:
    """The depth of furniture and floor with a network's errors, into the capture.

    Metric networks are off by some 5 to 6 % indoors (AbsRel on NYUv2; Depth Anything V2, UniDepth):
    a factor for the whole picture, one for each object, and one that changes over the picture.
    """
    rng, camera = np.random.default_rng([seed, 29]), room.truth.camera
    near, floor = surfaces(room)
    which = np.where(np.isinf(near.min(0)), len(near), near.argmin(0))
    off = rng.normal(0, 0.04, len(near) + 1)[which]
    wide = torch.from_numpy(rng.normal(0, 0.03, (1, 1, 4, 5)))
    size = (camera.height, camera.width)
    off += torch.nn.functional.interpolate(wide, size, mode="bicubic")[0, 0].numpy()
    off += rng.normal(0, 0.07) + rng.normal(0, 0.01, size)
    depth = np.minimum(near.min(0), floor) * np.exp(off)
    depth = np.where(depth < 20, depth, np.nan).astype(np.float32)
    values = depth if kind == "depth" else 200 / depth + rng.uniform(5, 30)
    (capture / kind).mkdir(parents=True, exist_ok=True)
    np.save(capture / kind / "000000.npy", values)


def surfaces(room: KnownRoom) -> tuple[np.ndarray, np.ndarray]:
    """Depth of each object and of the floor at each pixel [m]; infinite where it is not seen."""
    camera, ground = room.truth.camera, room.truth.ground
    assert ground is not None
    size, near = (camera.height, camera.width), list[np.ndarray]()
    for piece in room.truth.objects:
        mesh = place_object(piece)
        verts = to_camera(mesh.verts[None], camera.R_cam_world)
        shape = Topology(mesh.faces[None], edges_of(mesh.faces)[None])
        seen = look(verts, shape, Crops(camera.K[None], *size), depth=True)[1]
        assert seen is not None
        near.append(torch.where(seen.covered[0], seen.nearest[0], torch.inf).numpy())
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in size), indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(camera.K).mT
    down = to_world(rays, camera.R_cam_world)[..., 1].numpy()
    return np.stack(near), np.where(down < -0.01, ground / np.minimum(down, -0.01), np.inf)


def judged(capture: Path, found: Path, room: KnownRoom) -> dict[str, Any]:
    """Metrics of the first scene and of the result, over the objects that were found."""
    names = truth_of(room, capture)
    scenes = [renamed(read_scene(found / n), room, names) for n in ("initial.json", "scene.json")]
    kept = {p.id for p in scenes[0].objects}
    truth = replace(room.truth, objects=tuple(p for p in room.truth.objects if p.id in kept))
    people = [read_bodies(found / n) for n in ("initial_bodies.npz", "bodies.npz")]
    bodies = EvaluatedBodies(people[0], people[1], room.bodies)
    return evaluate(scenes[0], scenes[1], truth, bodies)


def farther(metrics: dict[str, Any]) -> list[str]:
    """Objects that end farther from their true position than they started."""
    return [
        f"{piece['id']} {100 * before:.0f} to {100 * after:.0f} cm"
        for piece in metrics["objects"]
        for before, after in [[piece[side].get("center_error", np.nan) for side in SIDES]]
        if after > before
    ]


def scale_of(found: Path, room: KnownRoom) -> dict[str, float]:
    """Height of the camera over the true one, of the first scene and of the room."""
    assert room.truth.ground is not None
    scenes = {
        side: read_scene(found / f"{n}.json")
        for side, n in zip(SIDES, ("initial", "scene"), strict=True)
    }
    return {f"{side} scale": (s.ground or np.nan) / room.truth.ground for side, s in scenes.items()}


def refined_errors(found: Path, room: KnownRoom) -> Errors:
    """Of the refined bodies in the room."""
    bodies, camera = read_bodies(found / "bodies.npz"), read_scene(found / "scene.json").camera
    there, true = in_world(bodies, camera), in_world(room.bodies, room.truth.camera)
    rows, true_rows = shared_rows(there, true)
    assert there.joints is not None
    assert true.joints is not None
    pairs = misses(there.joints[rows], true.joints[true_rows])
    return errors_by_posture(pairs, room, true_rows.tolist())


def lines_of_objects(metrics: dict[str, Any]) -> str:
    """IoU3D and error of the centre of each object, first scene -> room."""
    lines: list[str] = []
    for piece in metrics["objects"]:
        pairs = [
            " -> ".join(f"{piece[side].get(key, float('nan')):.3f}" for side in SIDES)
            for key in ("iou3d", "center_error")
        ]
        lines.append(f"  {piece['id']:<18} IoU3D {pairs[0]}   centre {pairs[1]} m")
    return "\n".join(lines)


def trial(seed: int, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One known room, from its video to its room; the room again with measured depth."""
    kept = out / "row.json"
    if kept.is_file():
        return json.loads(kept.read_text())
    room = make_room(seed, RoomConfig(fps=FPS))
    out.mkdir(parents=True, exist_ok=True)
    frames = range(int(room.bodies.frame.max()) + 1)
    if not (out / "video.mp4").is_file():
        save_film((draw_frame(room, k) for k in frames), FPS, out / "video.mp4")
    seen = Seen(room, add_noise(room, NoiseConfig(), seed), seed)
    kinds = {canonical(name): sorted(meanings(name)) for name in sorted(set(COCO.values()))}
    meshes = other_designs(room, out / "meshes", kinds) if args.other_designs else None
    heights = tuple(heights_in(room.bodies).tolist()) if args.height else ()
    lens, fields = out / "lens.json", camera_to_json(room.truth.camera)
    del fields["R_cam_world"]  # its tilt is not given
    write_json(fields, lens)
    chain = VideoArgs(out / "video.mp4", out / "chain", camera=lens, meshes=meshes, height=heights)
    video_to_room(chain, seen.finders())
    capture, row = out / "chain" / "capture", dict[str, Any]()
    for kind in ("", *args.depth):
        place = out / "chain" / f"room {kind}".rstrip()
        if kind:
            measured(room, seed, kind, capture)
            origin = Origin(str(capture), refine=True, device=torch.device("cpu"))
            reconstruct_into(place, read_capture(capture), PRESETS["robust"], origin)
            shutil.rmtree(capture / kind)
        metrics, word = judged(capture, place, room), f"{kind} ".lstrip()
        print(f"room {seed} {kind}", lines_of_objects(metrics), sep="\n", flush=True)
        row |= {f"{word}{s} {k}": metrics[s][k] for s in SIDES for k in KEYS if k in metrics[s]}
        row |= {f"{word}{name}": value for name, value in scale_of(place, room).items()}
        row |= {f"{word}postures": refined_errors(place, room)}
        row |= {f"{word}farther": farther(metrics), f"{word}objects": len(metrics["objects"])}
    steps = json.loads((out / "chain" / "steps.json").read_text())["steps"]
    row |= {f"{name} [s]": step["seconds"] for name, step in steps.items()}
    stages = json.loads((out / "chain" / "room" / "run.json").read_text())["stages"]
    row["room [s]"] = sum(stage["seconds"] for stage in stages)
    kept.write_text(json.dumps(row))
    return row


def main() -> None:
    """A table of means, and a line for each room."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="100-103")
    parser.add_argument("--out", type=Path, default=Path("video"))
    parser.add_argument("--other-designs", action="store_true", help="no mesh is the true one")
    parser.add_argument("--height", action="store_true", help="how tall people are is given")
    parser.add_argument("--depth", nargs="*", default=[], choices=KINDS, help="measured, too")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = {seed: trial(seed, args.out / str(seed), args) for seed in parse_seeds(args.seeds)}
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    for name in names:
        values = [row[name] for row in rows.values() if name in row]
        if isinstance(values[0], dict):
            print(lines_of_postures(values, "refined, "))
            continue
        if isinstance(values[0], list):
            print(f"{name}: {'; '.join(f'{s}: {v}' for s, row in rows.items() for v in row[name])}")
            continue
        each = " ".join(f"{v:.3f}" for v in values)
        print(f"{name:<24} {np.mean(values):8.3f}   {each}")


if __name__ == "__main__":
    main()
