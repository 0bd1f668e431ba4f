"""Reads Wavefront OBJ files into one TexturedMesh."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles, decode_picture
from avp_habitat.scenes.mesh import TexturedMesh, say_once
from avp_habitat.scenes.polygons import triangulate

_MOST_NUMBERS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
"""Numbers that follow an option of a texture at most; any other option has one word."""
_NEUTRAL = ("-bm", "-blendu", "-blendv", "-boost", "-cc", "-imfchan", "-texres", "-type")
"""Options that say nothing of a plain colour picture."""
_LOST = ("map_ka", "map_ke", "map_d")
"""Textures that are not shown."""
_LOST_NUMBERS = ("d", "ke")
"""Opacity and emitted light, which are not shown either; 1 and 0 where there is nothing to show."""


@dataclass
class Material:
    """What a material says about colour."""

    diffuse: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    """`Kd`, red, green and blue."""
    picture: str | None = None
    """File name of `map_Kd`, as it stands there."""
    scale: list[float] = field(default_factory=lambda: [1.0, 1.0])
    """`-s`: factors of the texture coordinates u and v."""
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """`-o`: added to the scaled texture coordinates, as Blender and three.js do."""
    lost: list[str] = field(default_factory=list)
    """What is not followed."""


class MaterialLibrary:
    """Materials by name, read line by line."""

    def __init__(self) -> None:
        """No material yet."""
        self.materials: dict[str, Material] = {}
        self._newest = Material()

    def take(self, word: str, rest: str) -> None:
        """Read one line, its first word apart.

        Raises:
            ValueError: it cannot be right.
        """
        key = word.lower()
        if key == "newmtl":
            self._newest = self.materials[rest] = Material()
        elif key == "kd":
            self._take_diffuse(rest)
        elif key == "map_kd":
            _take_texture(self._newest, rest)
        elif key in _LOST or (key in _LOST_NUMBERS and _is_lost(key, rest)):
            self._newest.lost.append(word if key in _LOST else f"{word} {rest}")

    def _take_diffuse(self, rest: str) -> None:
        words = rest.split()
        if words and words[0] in ("spectral", "xyz"):
            self._newest.lost.append(f"Kd {words[0]}")
            return
        numbers = [float(word) for word in words[:3]]
        if len(numbers) not in (1, 3):
            raise ValueError(f"expected one number or three, got {len(numbers)}")
        self._newest.diffuse = numbers * (3 // len(numbers))


def _take_texture(material: Material, rest: str) -> None:
    """Options, then the file's name, which may hold spaces."""
    rest = rest.strip()
    while rest.startswith("-"):
        option, *more = rest.split(None, 1)
        values, rest = _values(more[0] if more else "", _MOST_NUMBERS.get(option))
        numbers = [float(value) for value in values] if option in ("-s", "-o") else []
        if option == "-s":
            material.scale = (numbers + [1.0, 1.0][len(numbers) :])[:2]
        elif option == "-o":
            material.offset = (numbers + [0.0, 0.0][len(numbers) :])[:2]
        elif option not in _NEUTRAL and values != ["off"]:
            material.lost.append(f"{option} {' '.join(values)}")
    if not rest:
        raise ValueError("expected the name of a picture")
    material.picture = rest


def _values(text: str, most: int | None) -> tuple[list[str], str]:
    """An option's words and what follows them."""
    values: list[str] = []
    while len(values) < (most or 1) and text:
        word, *more = text.split(None, 1)
        if most is not None and not _is_number(word):
            break
        values.append(word)
        text = more[0] if more else ""
    return values, text


def _is_lost(key: str, rest: str) -> bool:
    numbers = [float(word) for word in rest.split() if _is_number(word)]
    return any(number < 1 if key == "d" else number > 0 for number in numbers)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


_MOST = 2**31 - 1
"""What an index of 32 bits can hold."""


def read_obj(files: SceneFiles) -> TexturedMesh:
    """The polygons of an `.obj` file as triangles, float64 positions in the file's axes.

    Colours are texture × `Kd` × vertex colour (`v x y z r g b`).

    Args:
        files: the file and its folder.

    Raises:
        SceneError: the file is damaged, holds no face, or refers to a file that is missing or outside its folder.
    """
    reader = _Reader(files)
    read_lines(str(files.path), files.main, reader.take)
    return reader.mesh()


def read_lines(name: str, content: bytes, take: Callable[[str, str], None]) -> None:
    """Hand each line of an OBJ or MTL to `take`, its first word apart; a backslash at the end continues a line.

    Raises:
        SceneError: `take` raised a ValueError; the text names the line.
    """
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
        self._lengths: list[int] = []
        self._names: dict[str | None, int] = {}
        self._material = self._number_of(None)
        self._materials: list[int] = []
        self._library = MaterialLibrary()
        self._takes = {"v": self._vertex, "vt": self._coordinate, "f": self._face, "usemtl": self._use}
        self._takes |= {"mtllib": self._read_library}

    def take(self, word: str, rest: str) -> None:
        """Read one line; what is not known has no surface.

        Raises:
            ValueError: it cannot be right.
        """
        if word in self._takes:
            self._takes[word](rest)

    def mesh(self) -> TexturedMesh:
        """All faces.

        Raises:
            SceneError: there are none, one names a vertex that is not there, or a picture cannot be read.
        """
        corners = np.array(self._corners, np.int64).reshape(-1, 2)
        for column, (kind, count) in enumerate((("v", len(self._positions)), ("vt", len(self._coordinates)))):
            if corners[:, column].max(initial=-1) >= count:
                raise SceneError(f"{self._files.path}: a face names {kind} {corners[:, column].max() + 1} of {count}")
        positions = np.array(self._positions, np.float64).reshape(-1, 3)
        try:
            places, polygons = triangulate(np.array(self._lengths, np.int64), corners[:, 0], positions)
        except ValueError as error:
            raise SceneError(f"{self._files.path}: {error}") from None
        if not len(places):
            raise SceneError(f"{self._files.path}: expected a mesh with triangles, found none")
        material = np.array(self._materials, np.int64)[polygons]
        # One vertex for each combination of position, texture coordinate and material.
        parts = np.stack([*corners[places].reshape(-1, 2).T, np.repeat(material, 3)])
        sizes = len(self._positions), len(self._coordinates) + 1, len(self._names)
        key, triangles = np.unique(np.ravel_multi_index(tuple(parts + [[0], [1], [0]]), sizes), return_inverse=True)
        position, coordinate, of_vertex = np.unravel_index(key, sizes)
        materials = [self._find(name) for name in self._names]
        slots, textures = self._textures(materials)
        textured = (corners[places][..., 1] >= 0).all(axis=1)
        return TexturedMesh(
            positions[position],
            triangles.reshape(-1, 3).astype(np.int32),
            self._uv(coordinate - 1, of_vertex, materials),
            self._colours(position, of_vertex, materials),
            np.where(textured, slots[material], -1).astype(np.int32),
            textures,
        )

    def _vertex(self, rest: str) -> None:
        numbers = [float(word) for word in _data(rest)]
        if len(numbers) < 3:
            raise ValueError(f"expected three coordinates for every vertex, got {len(numbers)}")
        self._positions.append(numbers[:3])
        self._light.append(numbers[3:6] if len(numbers) >= 6 else [1.0, 1.0, 1.0])

    def _coordinate(self, rest: str) -> None:
        numbers = [float(word) for word in _data(rest)[:2]]
        self._coordinates.append((numbers + [0.0, 0.0])[:2])

    def _face(self, rest: str) -> None:
        """Corners `v`, `v/vt`, `v//vn` or `v/vt/vn`."""
        words = _data(rest)
        for word in words:
            vertex, _, more = word.partition("/")
            coordinate = more.partition("/")[0]
            self._corners.append(
                (
                    _index(vertex, len(self._positions)),
                    _index(coordinate, len(self._coordinates)) if coordinate else -1,
                )
            )
        self._lengths.append(len(words))
        self._materials.append(self._material)

    def _use(self, rest: str) -> None:
        self._material = self._number_of(rest)

    def _number_of(self, name: str | None) -> int:
        return self._names.setdefault(name, len(self._names))

    def _read_library(self, rest: str) -> None:
        """A name with spaces, or several names."""
        whole = (self._files.path.parent / rest).is_file()
        for name in [rest] if whole else rest.split():
            read_lines(f"{self._files.path}: {name}", self._files.read(name), self._library.take)

    def _find(self, name: str | None) -> Material:
        material = Material() if name is None else self._library.materials.get(name)
        path = str(self._files.path)
        if material is None:
            say_once(path, f"its material {name!r} is in none of its libraries and is shown white")
            return Material()
        if material.picture and not any(material.diffuse):
            say_once(path, f"its material {name!r} has a picture and a black Kd, which is taken for white")
            material = replace(material, diffuse=[1.0, 1.0, 1.0])
        if material.lost:
            say_once(path, f"of its material {name!r}, {', '.join(material.lost)} is not followed")
        return material

    def _textures(self, materials: list[Material]) -> tuple[NDArray[np.int32], list[NDArray[np.uint8]]]:
        """The pictures, and which of them each material shows, -1 for none."""
        names = list(dict.fromkeys(each.picture for each in materials if each.picture is not None))
        slots = [-1 if each.picture is None else names.index(each.picture) for each in materials]
        return np.array(slots, np.int32), [
            decode_picture(self._files.read(name), f"{self._files.path}: {name}") for name in names
        ]

    def _uv(self, coordinate: NDArray, of_vertex: NDArray, materials: list[Material]) -> NDArray[np.float32]:
        """`(v, 2)`, v down, as each vertex's material moves them."""
        stored = np.array([*self._coordinates, [0.0, 1.0]], np.float64)[coordinate]
        scale, offset = (np.array([getattr(each, name) for each in materials]) for name in ("scale", "offset"))
        moved = stored * scale[of_vertex] + offset[of_vertex]
        return np.stack([moved[:, 0], 1 - moved[:, 1]], axis=1).astype(np.float32)

    def _colours(self, position: NDArray, of_vertex: NDArray, materials: list[Material]) -> NDArray[np.float32]:
        light = np.array(self._light, np.float64)
        # Some write bytes instead of shares.
        light /= 255 if light.max() > 2 else 1
        diffuse = np.array([each.diffuse for each in materials], np.float64)
        return np.clip(light[position] * diffuse[of_vertex], 0, 1).astype(np.float32)


def _data(rest: str) -> list[str]:
    """The words of a line of numbers, a comment behind them apart."""
    return rest.partition("#")[0].split()


def _index(text: str, count: int) -> int:
    """From 0; negative numbers count back from the newest one of `count` so far."""
    number = int(text)
    index = number - 1 if number > 0 else count + number
    if number > _MOST:
        raise ValueError(f"a face names {number}; expected {_MOST} at most")
    if number == 0 or index < 0:
        raise ValueError(f"{number} is none of the {count} before it; expected 1, 2, … or -1, -2, …")
    return index
