"""Reads Wavefront OBJ files and their material libraries (MTL) into one TexturedMesh."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles, decode_picture
from avp_habitat.scenes.mesh import TexturedMesh, triangulate, warn_once

_NUMBER = r"(?:\s*(?<!\S)[-+]?[\d.]+(?:e[-+]?\d+)?(?!\S))"
_OPTION = re.compile(rf"(-mm)\s+({_NUMBER}{{0,2}}+)\s*|(-[ost])\s+({_NUMBER}{{0,3}}+)\s*|(-\S+)\s*(\S*)\s*", re.I)
"""An option of a texture: up to two or three numbers follow some, one word any other."""
_NEUTRAL = ("-bm", "-blendu", "-blendv", "-boost", "-cc", "-imfchan", "-texres", "-type")
"""Options that say nothing of a plain colour picture."""
_LOST = ("map_ka", "map_ke", "map_d")
"""Textures that are not shown."""
_WHITE = (1.0, 1.0, 1.0)


@dataclass
class _Material:
    """What a material says about colour.

    `diffuse` is `Kd`; `picture` the file of `map_Kd`, whose texture coordinates are multiplied by `scale` (`-s`), then
    shifted by `offset` (`-o`), as Blender and three.js do; `unread` is what is not followed.
    """

    diffuse: tuple[float, ...] = _WHITE
    picture: str | None = None
    scale: tuple[float, ...] = (1.0, 1.0)
    offset: tuple[float, ...] = (0.0, 0.0)
    unread: list[str] = field(default_factory=list)

    def take(self, word: str, rest: str) -> None:
        """Follow one line of a library; ValueError where it cannot be right."""
        key = word.lower()
        if key == "kd":
            red, *others = (float(part) for part in rest.split()[:3])
            self.diffuse = (red, *others) if others else (red, red, red)
        elif key == "map_kd":
            self._take_texture(rest.strip())
        elif key in _LOST:
            self.unread.append(word)
        elif key in ("d", "ke"):
            numbers = [float(each) for each in re.findall(_NUMBER, rest, re.I)]
            if any(number < 1 if key == "d" else number > 0 for number in numbers):
                self.unread.append(f"{word} {rest}")

    def _take_texture(self, rest: str) -> None:
        """Options, then the file's name, which may hold spaces."""
        while rest.startswith("-") and (found := _OPTION.match(rest)):
            option, words = (part for part in found.groups() if part is not None)
            rest = rest[found.end() :]
            if option == "-s":
                self.scale = (*map(float, words.split()), 1.0, 1.0)[:2]
            elif option == "-o":
                self.offset = (*map(float, words.split()), 0.0, 0.0)[:2]
            elif option not in _NEUTRAL and words != "off":
                self.unread.append(f"{option} {words}")
        if not rest:
            raise ValueError("expected the name of a picture")
        self.picture = rest


def read_obj(files: SceneFiles) -> TexturedMesh:
    """The polygons of an `.obj` file as triangles, float64 positions in the file's axes.

    Colours are texture × `Kd` × vertex colour (`v x y z r g b`).

    Raises:
        SceneError: the file is damaged, holds no face, or refers to a file that is missing or outside its folder.
    """
    reader = _Reader(files)
    _read_lines(str(files.path), files.main, reader.take)
    with files.expected("a valid .obj file"):
        return reader.mesh()


def _read_lines(name: str, content: bytes, take: Callable[[str, str], None]) -> None:
    """Hand each line to `take`, its first word apart; a backslash at the end continues a line."""
    before = ""
    for number, raw in enumerate(content.decode("utf-8-sig", "surrogateescape").split("\n"), start=1):
        line = f"{before} {raw}".strip() if before else raw.strip()
        before = line[:-1] if line.endswith("\\") else ""
        if before or not line or line.startswith("#"):
            continue
        word, *rest = line.split(None, 1)
        try:
            take(word, rest[0] if rest else "")
        except ValueError as error:
            shown = ascii(line if len(line) <= 60 else f"{line[:57]}...")
            raise SceneError(f"{name}: {error} (line {number}: {shown})") from error


class _Reader:
    """An OBJ on its way to a mesh, line by line."""

    def __init__(self, files: SceneFiles) -> None:
        self._files = files
        self._positions: list[list[float]] = []
        self._light: list[list[float]] = []
        self._coordinates: list[list[float]] = []
        self._corners: list[tuple[int, int]] = []
        self._faces: list[tuple[int, int]] = []
        """How many corners each face has, and the number of its material."""
        self._names: dict[str | None, int] = {None: 0}
        self._material = 0
        self._library: dict[str, _Material] = {}

    def take(self, word: str, rest: str) -> None:
        """Read one line; what is not known has no surface. ValueError where it cannot be right."""
        if word == "v":
            self._vertex(rest)
        elif word == "vt":
            self._coordinates.append([*map(float, _words(rest)[:2]), 0.0, 0.0][:2])
        elif word == "f":
            self._face(rest)
        elif word == "usemtl":
            self._material = self._names.setdefault(rest, len(self._names))
        elif word == "mtllib":
            self._read_library(rest)

    def mesh(self) -> TexturedMesh:
        """All faces; SceneError where there are none, or one names a vertex that is not there."""
        corners = np.array(self._corners, np.int64).reshape(-1, 2)
        for column, (kind, count) in enumerate((("v", len(self._positions)), ("vt", len(self._coordinates)))):
            if corners[:, column].max(initial=-1) >= count:
                raise ValueError(f"a face names {kind} {corners[:, column].max() + 1} of {count}")
        positions = np.array(self._positions, np.float64).reshape(-1, 3)
        lengths, of_face = np.array(self._faces, np.int64).reshape(-1, 2).T
        places, polygons = triangulate(lengths, corners[:, 0], positions)
        if not len(places):
            raise SceneError(f"{self._files.path}: expected a mesh with triangles, found none")
        material = of_face[polygons]
        # One vertex for each combination of position, texture coordinate and material.
        parts = np.stack([*corners[places].reshape(-1, 2).T, np.repeat(material, 3)])
        sizes = len(self._positions), len(self._coordinates) + 1, len(self._names)
        key, triangles = np.unique(np.ravel_multi_index(tuple(parts + [[0], [1], [0]]), sizes), return_inverse=True)
        position, coordinate, of_vertex = np.unravel_index(key, sizes)
        materials = [self._find(name) for name in self._names]
        names = list(dict.fromkeys(each.picture for each in materials if each.picture is not None))
        slots = np.array([-1 if each.picture is None else names.index(each.picture) for each in materials])
        textured = (corners[places][..., 1] >= 0).all(axis=1)
        stored = np.array([*self._coordinates, [0.0, 1.0]], np.float64)[coordinate - 1]
        scale, offset, diffuse = (
            np.array([getattr(each, name) for each in materials])[of_vertex] for name in ("scale", "offset", "diffuse")
        )
        light = np.array(self._light, np.float64)
        # Some write bytes instead of shares.
        light /= 255 if light.max() > 2 else 1
        return TexturedMesh(
            positions[position],
            triangles.reshape(-1, 3).astype(np.int32),
            ((stored * scale + offset) * [1, -1] + [0, 1]).astype(np.float32),
            np.clip(light[position] * diffuse, 0, 1).astype(np.float32),
            np.where(textured, slots[material], -1).astype(np.int32),
            [decode_picture(self._files.read(name), f"{self._files.path}: {name}") for name in names],
        )

    def _vertex(self, rest: str) -> None:
        numbers = [float(word) for word in _words(rest)]
        if len(numbers) < 3:
            raise ValueError(f"expected three coordinates for every vertex, got {len(numbers)}")
        self._positions.append(numbers[:3])
        self._light.append(numbers[3:6] if len(numbers) >= 6 else [1.0, 1.0, 1.0])

    def _face(self, rest: str) -> None:
        """Corners `v`, `v/vt`, `v//vn` or `v/vt/vn`."""
        words = _words(rest)
        for word in words:
            vertex, coordinate, *_ = f"{word}//".split("/")
            of_vertex = _index(vertex, len(self._positions))
            self._corners.append((of_vertex, _index(coordinate, len(self._coordinates)) if coordinate else -1))
        self._faces.append((len(words), self._material))

    def _read_library(self, rest: str) -> None:
        """A name with spaces, or several names."""
        newest = _Material()

        def take(word: str, rest: str) -> None:
            nonlocal newest
            if word.lower() == "newmtl":
                newest = self._library[rest] = _Material()
            newest.take(word, rest)

        whole = (self._files.path.parent / rest).is_file()
        for name in [rest] if whole else rest.split():
            _read_lines(f"{self._files.path}: {name}", self._files.read(name), take)

    def _find(self, name: str | None) -> _Material:
        material = _Material() if name is None else self._library.get(name)
        path = str(self._files.path)
        if material is None:
            warn_once(path, f"its material {name!r} is in none of its libraries and is shown white")
            return _Material()
        if material.picture and not any(material.diffuse):
            warn_once(path, f"its material {name!r} has a picture and a black Kd, which is taken for white")
            material = replace(material, diffuse=_WHITE)
        if material.unread:
            warn_once(path, f"of its material {name!r}, {', '.join(material.unread)} is not followed")
        return material


def _words(rest: str) -> list[str]:
    """The words of a line of numbers, a comment behind them apart."""
    return rest.partition("#")[0].split()


def _index(text: str, count: int) -> int:
    """From 0; negative numbers count back from the newest one of `count` so far."""
    number = int(text)
    index = number - 1 if number > 0 else count + number
    if number == 0 or index < 0:
        raise ValueError(f"{number} is none of the {count} before it; expected 1, 2, … or -1, -2, …")
    return index
