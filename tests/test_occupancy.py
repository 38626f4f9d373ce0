"""The Occupancy Network: names and shapes of the published checkpoint, and its surfaces."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mover.core.errors import InputError
from mover.core.types import Mesh
from mover.geometry.mesh import box, signed_volume
from mover.geometry.occupancy import (
    OccupancyNetwork,
    extract,
    load_occupancy,
    network_of,
    occupied_mesh,
    refined,
)
from mover.geometry.topology import is_closed

CORNER = Mesh(
    torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def published(hidden: int, code: int, decoder: int) -> dict[str, tuple[int, ...]]:
    """Keys and shapes of the checkpoint, written out from the page of the authors' model."""
    norms = [f"decoder.block{k}.bn_{i}" for k in range(5) for i in (0, 1)] + ["decoder.bn"]
    layers: dict[str, tuple[int, ...]] = {
        "encoder.fc_pos": (2 * hidden, 3), "encoder.fc_c": (code, hidden),
        "decoder.fc_p": (decoder, 3, 1), "decoder.fc_out": (1, decoder, 1),
    }  # fmt: skip
    for k in range(5):
        layers[f"encoder.block_{k}.fc_0"] = (hidden, 2 * hidden)
        layers[f"encoder.block_{k}.fc_1"] = (hidden, hidden)
        layers |= {f"decoder.block{k}.fc_{i}": (decoder, decoder, 1) for i in (0, 1)}
    for norm in norms:
        layers |= {f"{norm}.conv_{part}": (decoder, code, 1) for part in ("gamma", "beta")}
    shapes = {f"{name}.weight": shape for name, shape in layers.items()}
    shapes |= {f"{name}.bias": shape[:1] for name, shape in layers.items()}
    shapes |= {f"encoder.block_{k}.shortcut.weight": (hidden, 2 * hidden) for k in range(5)}
    for norm in norms:
        shapes |= {f"{norm}.bn.running_{part}": (decoder,) for part in ("mean", "var")}
        shapes[f"{norm}.bn.num_batches_tracked"] = ()
    return shapes


def random_state(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for key, shape in shapes.items():
        value = torch.randn(shape, generator=generator) / math.sqrt(max(1, math.prod(shape[1:])))
        if key.endswith("running_var"):
            value = value.abs() + 0.5
        state[key] = torch.tensor(3) if key.endswith("tracked") else value
    return state


def by_hand(state: dict[str, torch.Tensor], cloud: torch.Tensor, point: torch.Tensor) -> float:
    """The network for one point of one shape, with plain matrices."""

    def linear(name: str, x: torch.Tensor) -> torch.Tensor:
        W = state[f"{name}.weight"]
        return x @ W.reshape(W.shape[0], -1).T + state[f"{name}.bias"]

    def norm(name: str, x: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        mean, var = state[f"{name}.bn.running_mean"], state[f"{name}.bn.running_var"]
        unit = (x - mean) / torch.sqrt(var + 1e-5)
        return linear(f"{name}.conv_gamma", c) * unit + linear(f"{name}.conv_beta", c)

    x = linear("encoder.fc_pos", cloud)
    for k in range(5):
        if k:
            x = torch.cat([x, x.max(0).values[None].repeat(len(x), 1)], 1)
        name = f"encoder.block_{k}"
        inner = linear(f"{name}.fc_0", x.clamp(min=0))
        x = x @ state[f"{name}.shortcut.weight"].T + linear(f"{name}.fc_1", inner.clamp(min=0))
    c = linear("encoder.fc_c", x.max(0).values.clamp(min=0))
    y = linear("decoder.fc_p", point)
    for k in range(5):
        name = f"decoder.block{k}"
        inner = linear(f"{name}.fc_0", norm(f"{name}.bn_0", y, c).clamp(min=0))
        y = y + linear(f"{name}.fc_1", norm(f"{name}.bn_1", inner, c).clamp(min=0))
    return float(linear("decoder.fc_out", norm("decoder.bn", y, c).clamp(min=0)))


def test_a_checkpoint_in_the_published_shapes_loads_by_its_keys(tmp_path: Path):
    shapes = published(512, 512, 256)
    state = random_state(shapes)
    tree = {
        "model": state, "optimizer": {"state": {}}, "epoch_it": 3, "it": 7, "loss_val_best": 0.5,
    }  # fmt: skip
    torch.save(tree, tmp_path / "new.pt")
    torch.save(tree, tmp_path / "old.pt", _use_new_zipfile_serialization=False)  # as in 2019
    for name in ("new.pt", "old.pt"):
        own = load_occupancy(tmp_path / name).weights
        assert set(own) == {k for k in shapes if not k.endswith("tracked")}
        assert all(torch.equal(v, state[k]) for k, v in own.items())


def test_it_computes_what_its_equations_say():
    state = random_state(published(12, 10, 8))
    network = network_of({"module." + k: v for k, v in state.items()})
    generator = torch.Generator().manual_seed(1)
    clouds, points = (torch.randn(2, n, 3, generator=generator) for n in (30, 4))
    found = network.decode(points, network.encode(clouds))
    expected = [[by_hand(state, clouds[i], points[i, j]) for j in range(4)] for i in range(2)]
    torch.testing.assert_close(found, torch.tensor(expected), rtol=1e-4, atol=1e-4)
    again = network.decode(points, network.encode(clouds.flip(1)))
    torch.testing.assert_close(again, found)  # the order of a cloud's points does not count


def test_old_checkpoints_do_not_count_batches_and_a_latent_code_is_at_its_mean():
    state = random_state(published(12, 10, 8))
    short = {k: v for k, v in state.items() if not k.endswith("tracked")}
    cloud, points = torch.ones(1, 5, 3), torch.zeros(1, 2, 3)

    def answer(of: dict[str, torch.Tensor]) -> torch.Tensor:
        network = network_of(of)
        return network.decode(points, network.encode(cloud))

    plain = answer(short)
    torch.testing.assert_close(plain, answer(state))
    bias = torch.zeros(8)
    latent = short | {"decoder.fc_z.weight": torch.randn(8, 6, generator=torch.Generator()),
                      "decoder.fc_z.bias": bias}  # fmt: skip
    torch.testing.assert_close(answer(latent), plain)


@pytest.mark.parametrize("change", ["missing", "unknown", "shape", "image", "list", "code"])
def test_other_files_are_refused_in_one_sentence(change: str, tmp_path: Path):
    state = random_state(published(12, 10, 8))
    match change:
        case "missing":
            del state["decoder.block2.fc_1.bias"]
        case "unknown":
            state["decoder.block5.fc_0.bias"] = torch.zeros(8)
        case "shape":
            state["decoder.bn.conv_beta.weight"] = torch.zeros(8, 9, 1)
        case "image":
            state = {k: v for k, v in state.items() if not k.startswith("encoder")}
        case "list":
            state = {"a": [1, 2]}
        case _:
            (tmp_path / "x.pt").write_bytes(b"\x80\x04\x95cos\nsystem\n.")
    if change != "code":
        torch.save({"model": state}, tmp_path / "x.pt")
    with pytest.raises(InputError, match=r"x\.pt: (is not|holds no|cannot be read)") as error:
        load_occupancy(tmp_path / "x.pt")
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="no such file"):
        load_occupancy(tmp_path / "y.pt")


def ball(centre: list[float], radius: float):
    at = torch.tensor(centre)
    return lambda p: 20 * (radius - (p - at).norm(dim=-1))


def test_a_known_field_becomes_its_surface():
    mesh = extract(ball([0.1, -0.05, 0.02], 0.3), coarse=16, threshold=0.5)
    assert is_closed(mesh.faces)
    assert signed_volume(mesh) == pytest.approx(4 / 3 * math.pi * 0.027, rel=0.01)
    radii = (mesh.verts - torch.tensor([0.1, -0.05, 0.02])).norm(dim=-1)
    assert (radii - 0.3).abs().max() < 0.002
    loose = extract(ball([0.0, 0, 0], 0.3), coarse=16)
    low, high = box(loose.verts)
    assert float((high - low).mean()) / 2 == pytest.approx(0.3 + math.log(4) / 20, abs=0.003)


def test_what_leaves_the_box_is_closed_at_its_walls():
    mesh = extract(lambda p: p[:, 1] * 10, coarse=8, levels=1, threshold=0.5)
    assert is_closed(mesh.faces)
    assert signed_volume(mesh) == pytest.approx(1.1 * 1.1 * 0.55, rel=0.15)


def test_refinement_finds_what_the_dense_grid_finds_with_few_points():
    generator = torch.Generator().manual_seed(2)
    centres = torch.rand(6, 3, generator=generator) * 0.6 - 0.3

    def field(p: torch.Tensor) -> torch.Tensor:
        counted.append(len(p))
        return 0.18 - (p[:, None] - centres).norm(dim=-1).amin(1)

    counted: list[int] = []
    sparse = refined(field, coarse=8, levels=2)
    assert sum(counted) < 0.5 * 33**3
    dense = refined(field, coarse=32, levels=0)
    assert torch.equal(sparse > 0, dense > 0)
    near = dense.abs() < 0.01
    torch.testing.assert_close(sparse[near], dense[near])


def test_nothing_inside_is_an_error():
    with pytest.raises(ValueError, match="nothing is inside"):
        extract(lambda p: -5 * torch.ones(len(p)))


def test_the_shape_comes_back_in_its_own_box_and_axes(monkeypatch: pytest.MonkeyPatch):
    seen: list[torch.Tensor] = []

    def encode(_: OccupancyNetwork, cloud: torch.Tensor) -> torch.Tensor:
        seen.append(cloud)
        return torch.zeros(1, 10)

    def decode(_: OccupancyNetwork, points: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
        del code  # a wedge along the network's x, which is our z: thick at its low end
        x, y, z = points[0].unbind(-1)
        half = 0.15 - 0.3 * x
        return 30 * torch.minimum(half - y.abs(), torch.minimum(0.4 - x.abs(), 0.3 - z.abs()))[None]

    monkeypatch.setattr(OccupancyNetwork, "encode", encode)
    monkeypatch.setattr(OccupancyNetwork, "decode", decode)
    network = OccupancyNetwork({})
    verts = CORNER.verts * torch.tensor([2.0, 1.0, 4.0])
    closed = occupied_mesh(network, Mesh(verts, CORNER.faces))
    assert is_closed(closed.faces)
    assert signed_volume(closed) > 0
    torch.testing.assert_close(torch.stack(box(closed.verts)), torch.stack(box(verts)))
    cloud = seen[0][0]
    assert cloud.shape == (2048, 3)
    assert cloud.abs().max() <= 0.5
    span = cloud.amax(0) - cloud.amin(0)
    torch.testing.assert_close(span, torch.tensor([1.0, 0.25, 0.5]), atol=0.05, rtol=0)
    thick = closed.verts[closed.verts[:, 2] < 0.5, 1]
    thin = closed.verts[closed.verts[:, 2] > 3.5, 1]
    assert float(thick.amax() - thick.amin()) > 2 * float(thin.amax() - thin.amin())


def test_furniture_is_closed_by_the_checkpoint_that_the_user_names(tmp_path, monkeypatch):
    """`--prepare.watertight occnet --prepare.occnet FILE`, on files in the published layout."""
    from test_prepare_objects import LIGHT, off_centre_box, piece_of

    from mover.stages.objects import prepare_objects as stage

    given = stage.PrepareInputs((piece_of(off_centre_box()),))
    config = replace(LIGHT, watertight="occnet")
    with pytest.raises(InputError, match=r"--prepare\.occnet: names no file"):
        stage.prepare_objects(given, config)
    with pytest.raises(InputError, match=r"gone\.pt"):
        stage.prepare_objects(given, replace(config, occnet=str(tmp_path / "gone.pt")))
    state = random_state(published(12, 10, 8))
    state["decoder.fc_out.weight"].zero_()
    state["decoder.fc_out.bias"].fill_(-5.0)  # nothing is inside
    torch.save({"model": state}, tmp_path / "empty.pt")
    config = replace(config, occnet=str(tmp_path / "empty.pt"))
    found = stage.prepare_objects(given, config)
    wrapped = stage.prepare_objects(given, LIGHT)
    assert any("Occupancy Network gave none" in text for text in found.warnings)
    assert torch.equal(found.objects.verts, wrapped.objects.verts)

    def halved(network: OccupancyNetwork, mesh: Mesh) -> Mesh:
        assert isinstance(network, OccupancyNetwork)
        return Mesh(mesh.verts * torch.tensor([1.0, 0.5, 1.0]), mesh.faces)

    monkeypatch.setattr(stage, "occupied_mesh", halved)
    lower = stage.prepare_objects(given, config).objects
    torch.testing.assert_close(lower.size, wrapped.objects.size * torch.tensor([1.0, 0.5, 1.0]))
