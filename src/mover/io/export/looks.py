"""What is seen of furniture, for simulators: OBJ with MTL and pictures, at its size, +z up."""

from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mover.core.colours import Colour
from mover.core.types import SceneObject
from mover.io.export.scene_glb import parts_of
from mover.io.export.solids import AXES, numbers

Rgba = tuple[float, float, float, float]


@dataclass(frozen=True)
class Look:
    """One part of a piece: a mesh of the user's file with its material."""

    name: str
    """Of its files, without their endings."""
    verts: Float[np.ndarray, "verts 3"]
    """In the piece's own axes, +z up, at its size [m]."""
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "verts 2"] | None
    """Texture coordinates from the lower left corner; None: no picture."""
    picture: bytes
    """PNG; empty: none."""
    rgba: Rgba
    """Colour on the screen, with which a picture is multiplied."""

    @property
    def image(self) -> str:
        """Name of the picture, the same for equal ones."""
        return sha256(self.picture).hexdigest()[:16]

    def files(self, folder: str) -> dict[str, bytes]:
        """Its mesh, its material and its picture by name, all in one folder."""
        named = {f"{self.name}.obj": self._obj(), f"{self.name}.mtl": self._mtl()}
        named |= {f"{self.image}.png": self.picture} if self.picture else {}
        return {f"{folder}/{name}": content for name, content in named.items()}

    def _obj(self) -> bytes:
        head = [f"mtllib {self.name}.mtl", f"usemtl {self.name}"]
        places = [f"v {numbers(v)}" for v in self.verts.tolist()]
        corners = [] if self.uv is None else [f"vt {numbers(c)}" for c in self.uv.tolist()]
        corner = "{0}" if self.uv is None else "{0}/{0}"
        rows = (" ".join(corner.format(k + 1) for k in face) for face in self.faces.tolist())
        return "\n".join([*head, *places, *corners, *(f"f {row}" for row in rows), ""]).encode()

    def _mtl(self) -> bytes:
        *colour, alpha = self.rgba
        lines = [f"newmtl {self.name}", f"Kd {numbers(colour)}", f"d {alpha:.4g}"]
        lines += [f"map_Kd {self.image}.png"] if self.picture else []
        return "\n".join([*lines, ""]).encode()


def looks_of(piece: SceneObject, tint: Colour, name: str) -> tuple[Look, ...]:
    """The meshes of the user's file with their materials; without any, the mesh in a colour.

    Args:
        piece: A piece of furniture.
        tint: Its colour where its file has none.
        name: What the names of the parts begin with; they end with `_look`.
    """
    stretch = AXES.numpy() * piece.scale.detach().cpu().double().numpy()
    found: list[Look] = []
    for k, (part, transform) in enumerate(parts_of(piece, tint)):
        flat = np.asarray(part.vertices) @ transform[:3, :3].T + transform[:3, 3]
        faces = np.asarray(part.faces)
        faces = faces[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0 else faces
        uv, picture, rgba = _material(part.visual, len(flat))
        found.append(Look(f"{name}_{k}_look", flat @ stretch.T, faces, uv, picture, rgba))
    return tuple(found)


def _material(
    visual: Any,  # noqa: ANN401
    count: int,
) -> tuple[Float[np.ndarray, "verts 2"] | None, bytes, Rgba]:
    """Texture coordinates, picture and colour; colours of vertices become their mean."""
    from trimesh.visual import ColorVisuals
    from trimesh.visual.material import PBRMaterial

    if isinstance(visual, ColorVisuals):
        return None, b"", _rgba(visual.vertex_colors.mean(0))
    material, uv = visual.material, visual.uv
    is_linear = isinstance(material, PBRMaterial)
    factor = material.baseColorFactor if is_linear else material.diffuse
    image = material.baseColorTexture if is_linear else material.image
    red, green, blue, alpha = (1.0,) * 4 if factor is None else _rgba(factor)
    if is_linear:
        red, green, blue = _on_screen(red), _on_screen(green), _on_screen(blue)
    if image is None or uv is None or len(uv) != count:
        return None, b"", (red, green, blue, alpha)
    if not is_linear:  # Kd of an OBJ is often 0.4 or 0.8 beside a picture that is meant as it is
        red = green = blue = 1.0
    return np.asarray(uv, np.float64)[:, :2], png_of(image), (red, green, blue, alpha)


def png_of(image: Any) -> bytes:  # noqa: ANN401
    """A picture of Pillow as PNG, with its cover where it has any."""
    stream = BytesIO()
    image.convert("RGBA" if "A" in image.getbands() else "RGB").save(stream, "PNG")
    return stream.getvalue()


def _rgba(values: Any) -> Rgba:  # noqa: ANN401
    """A colour of trimesh (0 to 255), with or without the share of cover."""
    red, green, blue, alpha = (float(v) / 255 for v in [*values, 255][:4])
    return red, green, blue, alpha


def _on_screen(light: float) -> float:
    """The sRGB value of an amount of light."""
    return 1.055 * light ** (1 / 2.4) - 0.055 if light > 0.0031308 else 12.92 * light
