"""Where the people lie in the files of a tool: one mapping of fields for each person or image."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mover.core.errors import InputError
from mover.io.files.fields import At, items, mapping, refuse
from mover.io.files.npz import read_npz
from mover.io.people.found import Known, followed, people_of
from mover.io.people.values import (
    KINDS,
    either,
    files_of,
    frame_numbers,
    natural,
    need,
    number_in,
    numbers,
    one_number,
    only_file,
    read_any,
    rows,
    stacked,
    whole,
)

TALL = 1.7  # [m], a person's size, by which people are followed from image to image


@dataclass(frozen=True)
class Person:
    """One person, with a row for each frame."""

    at: At
    """The fields of the rows."""
    track: int
    frame: int = 0
    """Of the first row, where no field holds the frames."""
    source: At | None = None
    """Where the tool keeps its camera."""
    model: str = ""
    """The body model where the file decides, else empty."""


def _in_folder(path: Path, *names: str) -> At:
    """The file itself, or the first of these that a folder has."""
    inside = (path / name for name in names if (path / name).is_file())
    return read_any(next(inside, path / names[0]) if path.is_dir() else path)


def gvhmr(path: Path, _: Known) -> list[Person]:
    """hmr4d_results.pt of GVHMR, smpl_params.pt of GEM: one person in all frames."""
    at = _in_folder(path, "hmr4d_results.pt", "smpl_params.pt")
    return [Person(need(at, "smpl_params_incam", "body_params_incam"), 0, source=at)]


def wham(path: Path, _: Known) -> list[Person]:
    """wham_output.pkl: people by their tracks."""
    return [Person(at, track) for track, at in people_of(_in_folder(path, "wham_output.pkl"))]


def prompthmr(path: Path, _: Known) -> list[Person]:
    """results.pkl: `people`, and the cameras beside them."""
    source = _in_folder(path, "results.pkl")
    found: list[Person] = []
    for track, one in people_of(need(source, "people")):
        body = need(one, "smplx_cam")
        fields = {**mapping(body), "frames": need(one, "frames").value}
        found.append(Person(At(fields, body.file, body.field), track, source=source))
    return found


def tram(path: Path, _: Known) -> list[Person]:
    """A folder with camera.npy and hps/hps_track_<k>.npy."""
    tracks = files_of(path, "hps/hps_track_*.npy", "TRAM's results")
    camera = (path if path.is_dir() else path.parent.parent) / "camera.npy"
    source = read_any(camera) if camera.is_file() else None
    return [Person(read_any(file), k, source=source) for k, file in enumerate(tracks)]


def pare(path: Path, known: Known) -> list[Person]:
    """pare_output.pkl or vibe_output.pkl of a video, or one pickle an image.

    Raises:
        InputError: If the lens is not known, for these networks have none.
    """
    if known.camera is None:
        raise InputError(f"{path.name}: PARE knows no lens: --camera names a camera.json")
    videos = [path / n for n in ("pare_output.pkl", "vibe_output.pkl") if (path / n).is_file()]
    if path.is_dir() and not videos:
        files = files_of(path, "*.pkl", "PARE's results")
        frames = [number_in(file.stem, index) - known.first for index, file in enumerate(files)]
    else:
        files, frames = [*videos, path][:1], [0]
        at = read_any(files[0])
        if either(at, "pred_cam") is None:
            return [Person(one, track) for track, one in people_of(at)]
    return [
        person
        for file, frame in zip(files, frames, strict=True)
        for person in _in_image(read_any(file), frame)
    ]


def _in_image(at: At, frame: int) -> Iterator[Person]:
    """The people of one image: a row each."""
    count = len(rows(need(at, "pred_cam"), None, 3))
    fields = mapping(at)
    for k in range(count):
        of_one = {
            name: value[k : k + 1] if np.ndim(value) and len(value) == count else value
            for name, value in fields.items()
        }
        yield Person(At({**of_one, "frame_ids": [frame]}, at.file, at.field), k)


def phalp(path: Path, _: Known) -> list[Person]:
    """results/demo_<video>.pkl of 4D-Humans: frames by name, whose lists go person by person.

    People who are only predicted in a frame, not detected, are left out.
    """
    source = read_any(only_file(path, "**/*.pkl", "the results of PHALP"))
    frames = mapping(source)
    found: list[Person] = []
    for index, name in enumerate(sorted(frames, key=lambda key: natural(Path(str(key))))):
        found += _in_frame(At(frames[name], source.file, str(name)), index)
    if not found:
        raise InputError(f"{source.file}: has no people in {len(frames)} frames")
    return found


def _in_frame(at: At, index: int) -> Iterator[Person]:
    camera = need(at, "camera")
    listed = list(camera.value) if isinstance(camera.value, np.ndarray) else camera.value
    bodies, cameras = items(need(at, "smpl")), items(At(listed, camera.file, camera.field))
    tracks = whole(need(at, "tid", "tracked_ids"))
    if not len(bodies) == len(cameras) == len(tracks):
        n = f"{len(tracks)} tracks, {len(bodies)} bodies and {len(cameras)} cameras"
        raise InputError(f"{at.place} has {n}, expected as many of each")
    ages, ids = either(at, "tracked_time"), either(at, "tracked_ids")
    detected = np.ones(len(tracks), dtype=bool)
    if ages is not None and numbers(ages).size == len(tracks):
        detected = numbers(ages).reshape(-1) == 0
    elif ids is not None:
        detected = np.isin(tracks, whole(ids))
    time = either(at, "time")
    frame = index if time is None or one_number(time) < 0 else int(one_number(time))
    for k in np.flatnonzero(detected):
        fields = {**mapping(bodies[k]), "camera": cameras[k].value}
        size = At({"size": mapping(at).get("size"), "row": int(k)}, at.file, at.field)
        person = At(fields, bodies[k].file, bodies[k].field)
        yield Person(person, int(tracks[k]), frame, size)


SLAHMR = {"trans": 3, "root_orient": 3, "pose_body": 63, "cam_R": 9, "cam_t": 3}
"""Numbers a row: of each person and frame, of each frame, of each person, or one for all."""


def slahmr(path: Path, _: Known) -> list[Person]:
    """The last *_world_results.npz of a folder: arrays of (people, frames, numbers).

    track_info.json beside it gives the tracks and the frames in which a person is visible.
    """
    path = files_of(path, "**/*_world_results.npz", "SLAHMR's results")[-1]
    source = read_any(path)
    shape = numbers(need(source, "trans")).shape
    if len(shape) != 3 or 0 in shape:
        raise InputError(f"{source.file}: field 'trans' has shape {shape}, expected (B, T, 3)")
    betas = numbers(need(source, "betas"))
    widths = {**SLAHMR, "betas": betas.size if betas.ndim < 2 else betas.shape[-1]}
    fields = [
        {name: _of_person(need(source, name), who, shape, n) for name, n in widths.items()}
        for who in range(shape[0])
    ]
    visible = _visible(path, shape[1])
    if not any(index < len(fields) for _, index, _ in visible):
        visible = [(who, who, np.arange(shape[1])) for who in range(shape[0])]
    found: list[Person] = []
    for track, index, frames in visible:
        if index < len(fields):
            of_one = {name: value[frames] for name, value in fields[index].items()}
            at = At({**of_one, "frames": frames, "row": index}, source.file)
            found.append(Person(at, track, source=source))
    return found


def _visible(path: Path, count: int) -> list[tuple[int, int, Any]]:
    """Track, index and visible frames of each person; empty without a file of tracks."""
    folders = (path.parent, path.parent.parent)
    file = next((f / "track_info.json" for f in folders if (f / "track_info.json").is_file()), None)
    found: list[tuple[int, int, Any]] = []
    if file is not None:
        for track, one in people_of(need(read_any(file), "tracks")):
            index = int(one_number(need(one, "index")))
            mask = numbers(need(one, "vis_mask")).reshape(-1) > 0
            if index >= 0 and len(mask) == count and mask.any():
                found.append((track, index, np.flatnonzero(mask)))
    return found


def _of_person(at: At, who: int, shape: tuple[int, ...], width: int) -> Any:  # noqa: ANN401
    people, frames = shape[:2]
    value = numbers(at)
    if value.size == people * frames * width:
        return value.reshape(people, frames, width)[who]
    if value.size == frames * width:
        return value.reshape(frames, width)
    if value.size not in (people * width, width):
        refuse(at, f"({people}, {frames}, {width}) numbers", f"shape {value.shape}")
    one = value.reshape(-1, width)
    return np.repeat(one[min(who, len(one) - 1)][None], frames, 0)


def smplifyx(path: Path, known: Known) -> list[Person]:
    """results/<frame>/<person>.pkl or <frame>.pkl of SMPLify-X and PROX, or one such file."""
    files = files_of(path, "**/*.pkl", "fits")
    if not path.is_dir():
        return [Person(read_any(files[0]), 0)]
    names: list[tuple[str, int]] = []
    for file in files:
        inside = re.fullmatch(r"\d{1,3}", file.stem) and re.search(r"\d", file.parent.name)
        names.append((file.parent.name, int(file.stem)) if inside else (file.stem, 0))
    frames = known.frames
    if frames is None:
        numbered = frame_numbers((name for name, _ in names), path.name)
        frames = {name: number - known.first for name, number in numbered.items()}
    found: list[Person] = []
    for file, (name, track) in zip(files, names, strict=True):
        if name not in frames:
            raise InputError(f"{file}: {name!r} is no frame of the recording")
        found.append(Person(read_any(file), track, frames[name]))
    return found


AMASS = {156: "smplh", 165: "smplx", 72: "smpl"}
"""Body models by the numbers of a row of `poses`."""
Y_UP = np.array([[1, 0, 0, 0, 0, 1, 0, -1, 0]])  # AMASS has +z up


def amass(path: Path, _: Known) -> list[Person]:
    """Motions of AMASS: one npz a person."""
    found: list[Person] = []
    for track, file in enumerate(files_of(path, "*.npz", "motions of AMASS")):
        at = read_npz(file, without_objects=True)
        width = rows(need(at, "poses"), len(stacked(need(at, "trans"), 3))).shape[1]
        if width not in AMASS:
            refuse(need(at, "poses"), f"rows of {' or '.join(map(str, AMASS))} angles")
        upright = {"turn": Y_UP, "shift": np.zeros(3)}
        at = At({**mapping(at), **upright}, at.file, at.field)
        found.append(Person(at, track, model=AMASS[width]))
    return found


# SAM 3D Body lists people by image: they are followed from image to image by their positions.


def sam3dbody(path: Path, known: Known) -> list[Person]:
    """A file a person (`<image>_subj00.npz`), a file an image, or one list for a video."""
    seen = _listed(path, known.first)
    if not seen:
        raise InputError(f"{path}: has no people, expected at least one")
    places = [
        stacked(need(at, "pred_vertices"), 3).mean(0) + rows(need(at, "pred_cam_t"), 1, 3)[0]
        for _, at in seen
    ]
    frames = [frame for frame, _ in seen]
    tracks = followed(frames, np.stack(places), np.full(len(seen), TALL))
    return [Person(at, int(t), frame) for t, (frame, at) in zip(tracks, seen, strict=True)]


def _listed(path: Path, first: int) -> list[tuple[int, At]]:
    """Frame and fields of all people of a file, or of a folder.

    Names that end in `_subj00` or `_person1` are people of the image before; then the last number
    of what is left is the frame, else the order.
    """
    if not path.is_dir():
        return _of_file(read_any(path), 0)
    files = sorted((f for f in path.iterdir() if f.suffix.lower() in KINDS), key=natural)
    if not files:
        raise InputError(f"{path}: has no files of kind {', '.join(KINDS)}")
    images = [re.sub(r"_?(?:subj|person|human)_?\d+$", "", file.stem) for file in files]
    digits = [re.findall(r"\d+", image) for image in images]
    numbered = [int(d[-1]) - first for d in digits if d]
    pairs = set(zip(numbered, images, strict=False))
    if len(numbered) < len(files) or len(pairs) > len(set(numbered)):
        order = {image: k for k, image in enumerate(dict.fromkeys(images))}
        numbered = [order[image] - first for image in images]
    return [
        one for file, n in zip(files, numbered, strict=True) for one in _of_file(read_any(file), n)
    ]


def _of_file(at: At, frame: int) -> list[tuple[int, At]]:
    """The people of one file: a person, a list of people, or lists by image."""
    value = at.value
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, Mapping):
        return _of_mapping(At(value, at.file, at.field), frame)
    if not isinstance(value, list | tuple):
        refuse(at, "a person, or a list of people")
    found: list[tuple[int, At]] = []
    for k, each in enumerate(value):
        one = At(each, at.file, f"{at.field}[{k}]")
        of_image = isinstance(each, list | tuple)
        found += _of_file(one, frame + k) if of_image else [(frame, one)]
    return found


def _of_mapping(at: At, frame: int) -> list[tuple[int, At]]:
    """One person, or lists of people by image number."""
    given: Mapping[Any, Any] = at.value
    lists = [isinstance(v, list | tuple) and all(isinstance(w, Mapping) for w in v)
             for v in given.values()]  # fmt: skip
    if given and all(lists):
        keys = [re.findall(r"\d+", str(key)) for key in given]
        frames = [int(k[-1]) for k in keys] if all(keys) else list(range(len(given)))
        return [
            one
            for number, (key, value) in zip(frames, given.items(), strict=True)
            for one in _of_file(At(list(value), at.file, str(key)), number)
        ]
    for name in ("humans", "people", "outputs"):
        if name in given:
            return _of_file(At(given[name], at.file, name), frame)
    return [(frame, at)]
