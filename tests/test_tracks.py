"""Which numbers are one person: of bodies and masks by position, of pieces, of two files."""

import functools
import json
import re
from dataclasses import replace

import little_room
import pytest
import torch

from mover.core.errors import InputError
from mover.core.types import Bodies, Camera, Capture, Masks, People
from mover.geometry.camera import project
from mover.geometry.rle import encode
from mover.io.capture.bodies_file import bodies_of, bodies_to_arrays
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.merge import import_into, with_parts
from mover.io.capture.parts import Parts
from mover.io.capture.tracks import join_pieces, pair_tracks
from mover.io.files.fields import At

CAMERA = Camera(
    torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]),
    torch.diag(torch.tensor([1.0, -1, -1])), 320, 240,
)  # fmt: skip
HUMAN = torch.tensor([0.5, 1.7, 0.3])
CORNERS = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3) * HUMAN
FACES = torch.tensor([[0, 1, 2]])
FRAMES = range(12)
Rows = list[tuple[int, int, tuple[float, float, float]]]
"""Frames, tracks and positions."""


def numbers_of(rows: Rows) -> list[torch.Tensor]:
    """Frames and tracks."""
    return [torch.tensor([row[k] for row in rows]) for k in (0, 1)]


def bodies_of_rows(rows: Rows) -> Bodies:
    """Boxes of a person's size, each a frame, a track and a position."""
    verts = torch.stack([CORNERS + torch.tensor(place) for _, _, place in rows])
    return Bodies(verts, FACES, None, (), *numbers_of(rows), 30.0, "camera", None)


def masks_of(rows: Rows, shown: float = 1.0) -> People:
    """Their boxes in the image, of which the upper part is shown."""
    codes: list[bytes] = []
    for _, _, place in rows:
        pixels = project(CORNERS + torch.tensor(place), CAMERA.K).round().long()
        (left, top), (right, low) = pixels.amin(0).clamp_min(0), pixels.amax(0)
        mask = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
        mask[top : top + round(float(low - top) * shown), left:right] = True
        codes.append(encode(mask))
    masks = Masks(CAMERA.height, CAMERA.width, tuple(codes))
    return People(masks, *numbers_of(rows), {"1": 1.8})


def walkers(first: int, second: int) -> Rows:
    """One walks from the left to the middle, the other stands at the right."""
    rows = [(f, first, (-1 + 0.05 * f, 0.0, 3.5)) for f in FRAMES]
    return rows + [(f, second, (1.0, 0.1, 4.0)) for f in FRAMES]


CASES = {  # numbers of bodies and masks: what the bodies' numbers and the masks' become
    "of two tools": ((7, 0), (1, 2), {}, {1: 7, 2: 0}),
    "from 1000": ((0, 1), (1000, 1001), {}, {1000: 0, 1001: 1}),
    "swapped": ((0, 1), (1, 0), {}, {1: 0, 0: 1}),
    "the same": ((3, 5), (3, 5), {}, {}),
}


def changed(old: Bodies | People, new: Bodies | People) -> dict[int, int]:
    """New numbers by old ones, where they differ."""
    pairs = zip(old.person.tolist(), new.person.tolist(), strict=True)
    return {one: other for one, other in pairs if one != other}


@pytest.mark.parametrize("shown", [1.0, 0.5])
@pytest.mark.parametrize("case", CASES)
def test_tracks_of_two_tools_are_paired_by_position(case, shown):
    ours, theirs, of_bodies, of_masks = CASES[case]
    bodies, people = bodies_of_rows(walkers(*ours)), masks_of(walkers(*theirs), shown)
    found, masks, notes = pair_tracks(bodies, people, CAMERA)
    assert changed(bodies, found) == of_bodies
    assert changed(people, masks) == of_masks
    assert len(notes) == bool(of_masks)
    assert torch.equal(masks.person, bodies.person)
    assert torch.equal(found.person, bodies.person)
    assert masks.heights == {str(of_masks.get(1, 1)): 1.8}


def test_pieces_are_one_person_where_the_other_side_is_whole():
    rows, cut = walkers(0, 1), in_pieces()
    bodies, people = bodies_of_rows(cut), replace(masks_of(rows), heights={"9": 1.7, "1": 1.8})
    found, masks, _ = pair_tracks(bodies, people, CAMERA)
    assert (changed(bodies, found), changed(people, masks)) == ({9: 0}, {})
    assert masks.heights == {"0": 1.7, "1": 1.8}
    bodies, people = bodies_of_rows(rows), masks_of(cut)
    found, masks, _ = pair_tracks(bodies, people, CAMERA)
    assert (changed(bodies, found), changed(people, masks)) == ({}, {9: 0})


def in_pieces() -> Rows:
    """The first walker has another number after frame 5."""
    return [(f, 9 if p == 0 and f > 5 else p, place) for f, p, place in walkers(0, 1)]


HEIGHTS = {  # bodies' and masks' numbers of two people; heights by the old and the new ones
    "swapped": ((0, 1), (1, 0), {"0": 1.5, "1": 1.8}, {"1": 1.5, "0": 1.8}),
    "of another tool": ((7, 0), (1, 2), {"2": 1.5, "1": 1.8, "9": 2},
                        {"0": 1.5, "7": 1.8, "9": 2}),
    "a taken number": ((2,), (0, 2), {"2": 1.5, "0": 1.8}, {"3": 1.5, "2": 1.8}),
}  # fmt: skip


@pytest.mark.parametrize("case", HEIGHTS)
def test_heights_in_a_written_capture_follow_the_new_numbers(case, tmp_path):
    ours, theirs, given, wanted = HEIGHTS[case]
    rows = [row for row in walkers(*ours, *[99][: 2 - len(ours)]) if row[1] != 99]
    people = replace(masks_of(walkers(*theirs)), heights=given)
    scene = replace(little_room.room(), camera=CAMERA, objects=())
    bodies = bodies_of_rows(rows)
    write_capture(Capture("room", scene, None, (), None, None, bodies, people, None, ()), tmp_path)
    capture = read_capture(tmp_path)
    assert capture.people.heights == wanted
    import_into(tmp_path, Parts("", bodies=At(bodies_to_arrays(bodies), "b.npz")))
    info = json.loads((tmp_path / "people.json").read_text())["info"]
    assert info["heights"] == wanted
    unknown = [text for text in read_capture(tmp_path).warnings if "unknown track 9" in text]
    assert bool(unknown) == ("9" in given)


def test_what_is_uncertain_keeps_its_number():
    """Two people close together under other numbers; and a mask elsewhere whose number is used."""
    near = [(f, p, (0.05 * p, 0.0, 3.5)) for f in FRAMES for p in (0, 1)]
    others = [(f, p + 5, place) for f, p, place in near]
    assert pair_tracks(bodies_of_rows(near), masks_of(others), CAMERA)[2] == ()
    alone = [(f, 0, (1.0, 0.0, 4.0)) for f in FRAMES]
    elsewhere = [(f, 0, (-1.2, 0.0, 5.0)) for f in FRAMES]
    elsewhere += [(f, 4, place) for f, _, place in alone]
    bodies, people = bodies_of_rows(alone), masks_of(elsewhere)
    found, masks, _ = pair_tracks(bodies, people, CAMERA)
    assert (changed(bodies, found), changed(people, masks)) == ({}, {4: 0, 0: 5})
    apart = replace(bodies, frame=torch.arange(100, 100 + len(FRAMES)))
    assert pair_tracks(apart, people, CAMERA)[2] == ()


def walk(spans: dict[int, range], step: float = 0.02) -> tuple[torch.Tensor, ...]:
    """One who walks to the right, as the tracks of these frames."""
    rows = [(f, track) for track, span in spans.items() for f in span]
    place = torch.tensor([[-1 + step * f, 0.1, 5.0 - step * f] for f, _ in rows])
    return torch.tensor([f for f, _ in rows]), torch.tensor([t for _, t in rows]), place


WHAM = {0: range(9), 4: range(11, 20), 17: range(23, 30), 31: range(32, 40)}


def with_other(rows: tuple[torch.Tensor, ...], spans: dict[int, range], x: float):
    """Another, who stands."""
    more = [(f, track) for track, span in spans.items() for f in span]
    place = torch.tensor([[x, 0.1, 5.0]]).expand(len(more), 3)
    frame, person = (torch.tensor([row[k] for row in more]) for k in (0, 1))
    return tuple(torch.cat(pair) for pair in zip(rows, (frame, person, place), strict=True))


def test_pieces_of_a_walker_become_one_and_it_is_said():
    rows = with_other(walk(WHAM), {2: range(5, 35)}, 2.0)
    assert join_pieces(*rows) == (
        {4: 0, 17: 0, 31: 0},
        ["tracks 0, 4, 17, 31 follow one another in time and position: one person, 0"],
    )


APART = {
    "a long gap": (walk({0: range(9), 4: range(60, 70)}), None, "0 and 4 .frames 8 and 60."),
    "elsewhere": (with_other(walk({0: range(9)}), {4: range(11, 20)}, 0.0), None, "0 and 4"),
    "far away": (with_other(walk({0: range(9)}), {4: range(11, 20)}, 3.0), None, None),
    "two that could": (
        with_other(walk({0: range(9), 4: range(11, 20)}), {5: range(12, 20)}, -0.75),
        None, "0 and 4"),
    "other shapes": (walk({0: range(9), 4: range(11, 20)}), {4: 3.0}, "0 and 4"),
    "at one time": (walk({0: range(9), 4: range(20)}), None, None),
}  # fmt: skip


@pytest.mark.parametrize("case", APART)
def test_what_may_be_another_person_is_named_and_not_joined(case):
    (frame, person, place), shapes, words = APART[case]
    betas = torch.zeros(len(frame), 10)
    for track, size in (shapes or {}).items():
        betas[person == track, 0] = size
    numbers, notes = join_pieces(frame, person, place, betas)
    assert numbers == {}
    assert len(notes) == bool(words)
    assert not words or re.search(rf"{words}.* may be one person; --tracks 4=0", notes[0])


# A second file of bodies.


def merged(*files: Bodies) -> tuple[Bodies, list[str]]:
    parts = [Parts("", bodies=At(bodies_to_arrays(one), f"{k}.npz")) for k, one in enumerate(files)]
    whole = functools.reduce(with_parts, parts)
    return bodies_of(whole.bodies, lambda _: None), list(whole.notes)


def standing(x: float, track: int = 0, frames: range = FRAMES, z: float = 4.0) -> Bodies:
    return bodies_of_rows([(f, track, (x, 0.0, z)) for f in frames])


SECOND = {  # tracks by where people stand, after a person at -1 with track 0; what is said
    "another with its number": ([standing(1)], {-1: 0, 1: 1}, "adds track 1"),
    "another with a free number": ([standing(1, 5)], {-1: 0, 1: 5}, "adds track 5"),
    "the same again": ([standing(-0.9)], {-0.9: 0}, "replaces track 0"),
    "the same by another tool": ([standing(-0.9, 8)], {-0.9: 0}, "its person 8 is person 0"),
    "the very same": ([standing(-1)], {-1: 0}, None),
    "the next frames": ([standing(-1, 0, range(12, 20))], {-1: 0}, "adds track 0"),
    "another in later frames": ([standing(1, 0, range(12, 20))], {-1: 0, 1: 1}, "adds track 1"),
    "two more": ([standing(1), standing(0.2)], {-1: 0, 1: 1, 0.2: 2}, "adds track 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", SECOND)
def test_a_second_file_adds_people_and_says_so(case):
    files, tracks, words = SECOND[case]
    found, notes = merged(standing(-1), *files)
    middle = found.verts.mean(1)[:, 0]
    for x, track in tracks.items():
        assert found.person[(middle - x).abs() < 0.01].unique().tolist() == [track]
    assert len(found.person.unique()) == len(set(tracks.values()))
    pairs = list(zip(found.frame.tolist(), found.person.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    assert words in "\n".join(notes) if words else not notes


def test_bodies_of_two_topologies_are_not_mixed():
    other = replace(standing(1), faces=torch.tensor([[0, 2, 1]]))
    with pytest.raises(InputError, match=r"1\.npz: has bodies of 8 vertices.*one topology"):
        merged(standing(-1), other)
    found, _ = merged(standing(-1), replace(standing(-1), faces=other.faces))
    assert torch.equal(found.faces, other.faces)
