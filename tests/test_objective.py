"""The lists of terms: every weight counts in the energy that a run uses, a newcomer's, too."""

from dataclasses import dataclass, fields, replace

import pytest
import torch
from analytic import make_inputs, moved, walls_at
from reference import use_engine

from mover.core.types import Layout
from mover.energy import objective
from mover.energy.body_terms import BODY_TERMS
from mover.energy.config import BodyWeights, SceneConfig, SceneWeights, only
from mover.energy.fused import energy
from mover.energy.fused.energy import energy_function, energy_of_rows
from mover.energy.minimize import Term
from mover.energy.objective import (
    SCENE_TERMS,
    SceneEvidence,
    energy_of_terms,
    of_objects,
    scene_energy,
)
from mover.pipeline.presets import PRESETS
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_inputs import with_walls
from mover.stages.objects.place_objects import energy_of

WEIGHTS = [f.name for f in fields(SceneWeights)]
PRECISIONS = [torch.float32, torch.float64]


def evidence(dtype):
    """The analytic room with evidence for every term, and layouts about the truth."""
    inputs = make_inputs(dtype, size=32)
    truth = inputs.starts[0]
    inputs = with_walls(inputs, walls_at(inputs.objects, truth))
    many = [moved(inputs.starts, seed, 0.2) for seed in range(2)]
    return inputs, Layout.cat(*many)


def some_of(layout, rows):
    return Layout(*(getattr(layout, f.name).flatten(0, 1)[rows] for f in fields(Layout)))


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", WEIGHTS)
def test_every_weight_counts_in_the_energy_of_a_run(name, preset, dtype):
    place = PRESETS[preset].place
    weights = replace(place.weights, **{name: getattr(place.weights, name) or 0.5})
    inputs, layout = evidence(dtype)
    found = energy_of(inputs, PlaceConfig(weights, place.form))(layout)
    assert set(found.parts) == {n for n in WEIGHTS if getattr(weights, n)}
    whole = torch.stack(list(found.parts.values())).sum(0)
    torch.testing.assert_close(found.per_item, whole, rtol=1e-4, atol=1e-5)
    without = energy_of(inputs, PlaceConfig(replace(weights, **{name: 0.0}), place.form))(layout)
    assert name not in without.parts
    if name not in ("contact", "silhouette", "bbox"):  # these weigh or fit other terms, too
        gap = found.per_item - without.per_item
        rounding = 4 * torch.finfo(dtype).eps * float(found.per_item.abs().max())
        torch.testing.assert_close(gap, found.parts[name], rtol=1e-4, atol=rounding)


def test_the_list_has_each_weight_once_in_its_order():
    assert [t.name for t in SCENE_TERMS] == WEIGHTS
    assert [t.name for t in BODY_TERMS] == [f.name for f in fields(BodyWeights)]


def test_the_evidence_of_each_term_exists_and_silences_it_where_it_is_missing():
    inputs, _ = evidence(torch.float32)
    known = objective.SceneEvidence(inputs.objects, inputs.camera, inputs.image, inputs.humans)
    for term in SCENE_TERMS:
        for need in term.needs:
            assert known.has(need)
            image, humans = (
                replace(x, **{need: None}) if hasattr(x, need) else x
                for x in (inputs.image, inputs.humans)
            )
            less = objective.SceneEvidence(inputs.objects, inputs.camera, image, humans)
            all_on = SceneConfig(only(**dict.fromkeys(WEIGHTS, 1.0)))
            left = objective.active_config(all_on, less).weights
            silent = {t.name for t in SCENE_TERMS if need in t.needs}
            assert {n for n in WEIGHTS if not getattr(left, n)} == silent


@pytest.mark.parametrize("term", [t for t in SCENE_TERMS if t.bare], ids=lambda t: t.name)
def test_a_bare_term_sees_no_meshes_no_maps_and_no_people(term):
    inputs, layout = evidence(torch.float32)
    known = SceneEvidence(inputs.objects, inputs.camera, inputs.image, inputs.humans)
    config = SceneConfig(only(**{term.name: 0.7}), "robust")
    rows = torch.tensor([5, 1, 3])
    for some, at in ((known, layout), (known.some(rows), some_of(layout, rows))):
        wanted = energy_of_terms([term], at, some, config).per_item
        bare = energy_of_terms([term], at, some.bare(), config).per_item
        assert torch.equal(bare, wanted)
        assert bool(wanted.any())
    parts = known.bare().objects, known.bare().image
    sizes = {x.numel() for x in (parts[0].verts, parts[0].faces, parts[1].masks, parts[1].keep)}
    assert sizes == {0}


def test_terms_of_the_kernel_are_in_the_order_of_its_constants():
    pytest.importorskip("warp")
    from mover.energy.fused.kernels import data
    from mover.energy.fused.launch import FUSED, TERMS

    assert len(FUSED) == TERMS
    assert [getattr(data, name.upper()) for name in FUSED] == list(range(TERMS))


@dataclass(frozen=True)
class More(SceneWeights):
    """The weights and a newcomer's."""

    newcomer: float = 0.7


@pytest.fixture
def newcomer(monkeypatch):
    """A term with a file of its own, a weight and a row; it needs the evidence `distance`."""

    def newcomer_term(state):
        return (state.layout.t_world_object[..., 0] - state.known.image.distance).square()

    row = Term("newcomer", newcomer_term, ("distance",))
    for module in (objective, energy):
        monkeypatch.setattr(module, "SCENE_TERMS", (*SCENE_TERMS, row))


@pytest.mark.usefixtures("newcomer")
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("engine", ["warp", "torch"])
class TestANewcomer:
    def test_counts_among_all_and_by_rows(self, preset, dtype, engine):
        place = PRESETS[preset].place
        inputs, layout = evidence(dtype)
        rest = inputs.objects, inputs.camera, inputs.image, inputs.humans
        weights = More(**{n: getattr(place.weights, n) for n in WEIGHTS})
        config = SceneConfig(weights, place.form)
        with use_engine(engine):
            less = replace(config, weights=replace(weights, newcomer=0.0))
            found, plain = (energy_function(*rest, c)(layout) for c in (config, less))
            term = 0.7 * (layout.t_world_object[..., 0] - inputs.image.distance).square()
            torch.testing.assert_close(found.parts["newcomer"], term)
            torch.testing.assert_close(found.per_item, plain.per_item + term)
            rows = torch.tensor([4, 0, 2])
            some = energy_of_rows(*rest, config)(rows)(some_of(layout, rows))
            torch.testing.assert_close(some.parts["newcomer"], term.flatten()[rows])
            every = found.per_item.flatten()[rows]
            torch.testing.assert_close(some.per_item, every, rtol=1e-4, atol=1e-4)
            blind = (*rest[:2], replace(inputs.image, distance=None), rest[3])
            assert "newcomer" not in energy_function(*blind, config)(layout).parts


@pytest.mark.parametrize("preset", PRESETS)
def test_evidence_by_rows_is_that_of_the_objects(preset):
    place = PRESETS[preset].place
    inputs, layout = evidence(torch.float64)
    rest = inputs.objects, inputs.camera, inputs.image, inputs.humans
    config = SceneConfig(only(**dict.fromkeys(WEIGHTS, 0.5)), place.form)
    rows = torch.tensor([5, 1, 3, 1])
    whole = scene_energy(layout, *rest, config)
    some = energy_of_rows(*rest, config)(rows)(some_of(layout, rows))
    assert set(some.parts) == set(whole.parts) == set(WEIGHTS)
    for name, values in some.parts.items():
        wanted = whole.parts[name].flatten()[rows]
        torch.testing.assert_close(values, wanted, rtol=1e-6, atol=1e-9)


def test_a_tensor_is_indexed_where_its_annotation_counts_objects():
    inputs, _ = evidence(torch.float32)
    index = torch.tensor([2, 0])
    image = of_objects(inputs.image, index, 3)
    assert torch.equal(image.boxes, inputs.image.boxes[index])
    assert torch.equal(image.views.K, inputs.image.views.K[index])
    assert torch.equal(image.walls.trust, inputs.image.walls.trust[index])
    assert torch.equal(image.walls.offset, inputs.image.walls.offset)
    humans = of_objects(inputs.humans, index, 3)
    assert humans.space.volume.values is inputs.humans.space.volume.values
    assert humans.touches.object_of.tolist() == [1]
    assert torch.equal(humans.touches.points[0], inputs.humans.touches.points[0])
