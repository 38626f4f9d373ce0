"""Single objects in the world, as OBJ with their textures and as PLY."""

from pathlib import Path

from ..export import parts_of, placement_of
from ..records import replacing
from ..report_colours import colour
from .finished import Exported, Finished


def export_objects(finished: Finished, folder: Path) -> Exported:
    """Write each object by itself, where it stands in the world [m].

    Args:
        finished: The result.
        folder: Gets `objects/<id>.ply` (shape alone) and `objects/<id>/<id>.obj` (with materials
            and textures).
    """
    import trimesh

    files: list[Path] = []
    for index, piece in enumerate(finished.scene.pieces):
        placed = trimesh.Scene()
        for part, transform in parts_of(piece, colour(index)):
            placed.add_geometry(part, transform=placement_of(piece) @ transform)
        whole = placed.to_mesh()
        plain = trimesh.Trimesh(whole.vertices, whole.faces, process=False)
        path = folder / "objects" / f"{piece.id}.ply"
        with replacing(path) as target:
            plain.export(target)
        home = folder / "objects" / piece.id
        home.mkdir(parents=True, exist_ok=True)
        placed.export(home / f"{piece.id}.obj", mtl_name=f"{piece.id}.mtl")
        files += [path, home / f"{piece.id}.obj"]
    return Exported(tuple(files))
