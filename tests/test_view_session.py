"""The state behind the viewer: edits on a result, saved at once, and the numbers of an object."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from little_room import GROUND, room, walkers

from mover.app.viewer.drawing import DrawnPeople, Shown, start_session
from mover.app.viewer.show import numbers_of
from mover.core.records import rows_of
from mover.io.capture.edits import Delete, Place, placement_of, read_edits, write_edits


def shown(scene=None, **log):
    scene = scene or room()
    return Shown("room", scene, room(0.3), walkers(), walkers(), log=log)


def test_every_change_is_on_disk_and_an_undo_takes_it_back(tmp_path: Path):
    file = tmp_path / "edits.json"
    session = start_session(shown(), file)
    moved = dataclasses.replace(session.object_named("chair_0"), yaw=torch.tensor(2.0))
    session.put(moved)
    session.put(moved)  # nothing new
    session.pin("chair_0", True)
    session.select("table_0")
    session.delete("table_0")
    assert session.selected is None
    assert session.pinned == ("chair_0",)
    assert len(read_edits(file)) == len(session.edits) == 3
    again = start_session(shown(), file)
    assert float(again.object_named("chair_0").yaw) == pytest.approx(2.0, abs=1e-6)
    assert again.object_named("table_0") is None
    session.undo()
    assert session.object_named("table_0") is not None
    assert len(read_edits(file)) == 2


def test_edits_of_a_run_are_inside_of_its_result_and_new_ones_do_not_replace_them(tmp_path: Path):
    first = room()
    put = dataclasses.replace(first.objects[0], t_world_object=torch.tensor([0.1, GROUND, -2.0]))
    edits = (Delete("sofa_0"), placement_of(put, first))
    write_edits(edits, tmp_path / "edits.json")
    rest = tuple(put if o.id == put.id else o for o in first.objects if o.id != "sofa_0")
    solved = shown(dataclasses.replace(first, objects=rest), edits=2)
    session = start_session(solved, tmp_path / "edits.json")
    assert {o.id for o in session.scene.objects} == {"chair_0", "table_0"}
    session.put(dataclasses.replace(put, t_world_object=torch.tensor([0.2, GROUND, -2.0])))
    assert [type(e) for e in session.edits] == [Delete, Place, Place]


def test_the_table_of_an_object_has_position_change_and_evidence():
    log = {"evidence": [{"id": "chair_0", "mask_pixels": 4321}]}
    table = numbers_of(room().objects[0], room(), shown(**log))
    for words in ("4,321", "50, 90, 50 cm", "17°", "moved since the start"):
        assert words in table
    assert "nan" not in table


def test_people_are_found_by_frame_and_person():
    drawn = {}

    def add(name, verts, _faces, **_looks):
        drawn[name] = SimpleNamespace(vertices=verts, remove=lambda: drawn.pop(name))
        return drawn[name]

    people = DrawnPeople(SimpleNamespace(scene=SimpleNamespace(add_mesh_simple=add)))
    bodies = rows_of(walkers(5, people=2), torch.arange(9))  # the last frame lacks the second
    people.replace(bodies)
    assert people.frames == [0, 3, 6, 9, 12]
    for moment, frame in ((2, 6), (4, 12), (9, 12), (1, 3)):
        people.show(moment)
        for person in (0, 1):
            row = ((bodies.frame == frame) & (bodies.person == person)).nonzero()[:, 0]
            handle = drawn[f"/people/{person}"]
            assert handle.visible == bool(len(row))
            if len(row):
                verts = bodies.verts[row[0], people.few.kept].numpy()
                assert np.array_equal(handle.vertices, verts)
    people.replace(None)
    assert people.bodies is None
    assert drawn == {}
