"""Reads PLY files, text or binary, into one TexturedMesh.

Layout: header of elements (`vertex`, `face`, …) with typed properties, then their rows; a property that is a list has
a number of values of its own in each row (G. Turk, The PLY Polygon File Format).
"""

import re
import struct
import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles, decode_picture
from avp_habitat.scenes.mesh import TexturedMesh, triangulate, warn_once

_CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_CODES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_CODES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_COLOUR_LIKE = re.compile(r"red|rgb|colou?r|f_dc|intensity|material_ind", re.IGNORECASE)
"""Names of properties that may mean a colour."""


class _Property(NamedTuple):
    """How values lie in the body, where a text's numbers are float64; a single value has no type of a count."""

    name: str
    values: np.dtype
    count: np.dtype | None
    integer: bool


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


class _Column(NamedTuple):
    """The values of a property, row after row, and `(rows,)` how many of them each row has."""

    values: NDArray
    lengths: NDArray[np.int64]
    integer: bool


_Columns = dict[str, _Column]


def read_ply(files: SceneFiles) -> TexturedMesh:
    """The polygons of a `.ply` file as triangles, float64 positions in the file's axes.

    Colours are those of vertices, else those of faces; a texture is named by a comment `TextureFile NAME`.

    Raises:
        SceneError: the file is damaged, holds no face, or refers to a file that is missing or outside its folder.
    """
    with files.expected("a valid .ply file"):
        return _mesh(files, *_tables(files.main))


def _tables(content: bytes) -> tuple[dict[str, _Columns], list[str]]:
    """The columns of each element, and the names of the textures."""
    end = re.search(rb"\bend_header[ \t]*(\r\n|\n|\r|$)", content)
    if not content.startswith(b"ply"):
        raise ValueError("it does not begin with the line ply")
    if end is None:
        raise ValueError("truncated: expected a header that ends with end_header")
    lines = content[: end.start()].decode("utf-8", "replace").splitlines()
    order, elements = _header([line.split() for line in lines[1:] if line.strip()])
    text, body = order == "=", content[end.end() :]
    body = _numbers(body) if text else body
    at, tables = 0, {}
    for element in elements:
        tables[element.name], at = _read(element, body, at)
    if text and at < len(body):
        raise ValueError(f"{(len(body) - at) // 8} numbers are left over after the last row of {elements[-1].name}")
    textures = (re.match(r"(?i)comment\s+TextureFile\s+(.+)", line) for line in lines)
    return tables, [found[1].strip() for found in textures if found]


def _header(lines: list[list[str]]) -> tuple[str, list[_Element]]:
    order, elements = "", []
    for words in lines:
        if words[0] == "format":
            order = _ORDERS[words[1]]
        elif words[0] == "element":
            elements.append(_Element(words[1], int(words[2]), []))
            if elements[-1].rows < 0:
                raise ValueError(f"element {words[1]} has {words[2]} rows")
        elif words[0] == "property":
            codes = [_CODES.get(word) for word in (words[2:4] if words[1] == "list" else words[1:2])]
            if None in codes or not order:
                raise ValueError(f"expected a property of a known type, got {' '.join(words[1:])}")
            *count, values = (np.dtype("=f8" if order == "=" else f"{order}{code}") for code in codes)
            integer = str(codes[-1])[0] in "iu"
            elements[-1].properties.append(_Property(words[-1], values, count[0] if count else None, integer))
    if not order:
        raise ValueError("the header names no format")
    return order, elements


def _numbers(text: bytes) -> bytes:
    """The numbers of a text as float64."""
    with warnings.catch_warnings():
        # What is no number ends the reading with a warning only.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text.decode("ascii"), np.float64, sep=" ").tobytes()
        except (DeprecationWarning, ValueError):
            raise ValueError("expected numbers after the header, got something else") from None


def _read(element: _Element, body: bytes, start: int) -> tuple[_Columns, int]:
    """The columns of an element whose rows start at a byte of the body, and where they end."""
    properties, rows = element.properties, element.rows
    if not rows or not properties:
        return {}, start
    lengths = _walk(element, body, start, 1)[0][0, :, 1].tolist()
    table = _table(element, body, start, lengths)
    if table is not None:
        end = start + table.nbytes
        columns = [(table[f"values {k}"].reshape(-1), np.full(rows, length)) for k, length in enumerate(lengths)]
    else:
        places, end = _walk(element, body, start, rows)
        columns = []
        for each, own in zip(properties, places.transpose(1, 0, 2), strict=True):
            parts = [body[at : at + count * each.values.itemsize] for at, count in own.tolist()]
            columns.append((np.frombuffer(b"".join(parts), each.values), own[:, 1]))
    found = zip(properties, columns, strict=True)
    return {each.name: _Column(values, lengths, each.integer) for each, (values, lengths) in found}, end


def _table(element: _Element, body: bytes, start: int, lengths: list[int]) -> NDArray[np.void] | None:
    """All rows at once where the lists of each are as long as those of the first one; None where they are not."""
    fields = []
    for number, (each, length) in enumerate(zip(element.properties, lengths, strict=True)):
        fields += [] if each.count is None else [(f"count {number}", each.count)]
        fields.append((f"values {number}", each.values, (length,)))
    row, lists = np.dtype(fields), [number for number, each in enumerate(element.properties) if each.count is not None]
    if lists and row.itemsize * element.rows > len(body) - start:
        return None
    table = np.frombuffer(body, row, element.rows, start)
    return table if all((table[f"count {number}"] == lengths[number]).all() for number in lists) else None


def _walk(element: _Element, body: bytes, at: int, rows: int) -> tuple[NDArray[np.int64], int]:
    """`(rows, properties, 2)` first byte and number of values of each property, and where the last row ends."""
    places = []
    stored = [(each.count, each.values.itemsize) for each in element.properties]
    steps = [(n and struct.Struct(n.byteorder.replace("|", "=") + n.char), size) for n, size in stored]
    for _ in range(rows):
        for count, size in steps:
            length = 1
            if count and at + count.size <= len(body):
                length, at = int(count.unpack_from(body, at)[0]), at + count.size
            places.append((at, length))
            at += length * size
            if length < 0 or at > len(body):
                raise ValueError(f"truncated: the rows of {element.name} do not end where the file does")
    return np.array(places, np.int64).reshape(rows, len(steps), 2), at


def _mesh(files: SceneFiles, tables: dict[str, _Columns], pictures: list[str]) -> TexturedMesh:
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    positions = _together(vertex, ("x", "y", "z"))
    listed = next((face[name] for name in _CORNERS if name in face), None)
    if positions is None or listed is None:
        kinds = ", ".join(f"{name} ({', '.join(columns)})" for name, columns in tables.items() if columns)
        raise SceneError(
            f"{files.path}: expected a mesh with triangles, found none, but {kinds or 'nothing'}; is it a point cloud?"
        )
    named = listed.values.astype(np.int64)
    if len(named) and not 0 <= named.min() <= named.max() < len(positions):
        raise ValueError(f"a face names vertices {named.min()} to {named.max()} of {len(positions)}")
    corners, faces = triangulate(listed.lengths, named, positions)
    triangles = named[corners]
    colours, of_faces, uv = _colours(vertex), _colours(face), _wedges(face, listed, corners)
    if (colours is None and of_faces is not None) or uv is not None:
        # Colours and texture coordinates of faces: each triangle gets corners of its own.
        if colours is not None:
            colours = colours[triangles].reshape(-1, 3)
        elif of_faces is not None:
            colours = np.repeat(of_faces[faces], 3, axis=0)
        positions = positions[triangles].reshape(-1, 3)
        triangles = np.arange(len(positions)).reshape(-1, 3)
    else:
        uv = next((found for names in _COORDINATES if (found := _together(vertex, names)) is not None), None)
    if colours is None and (uv is None or not pictures):
        _warn_of_unread_colours(files, [*vertex, *face], pictures)
    textures = [decode_picture(files.read(name), f"{files.path}: {name}") for name in pictures]
    if uv is None:
        textures, uv = [], np.tile([0.0, 1.0], (len(positions), 1))
    return TexturedMesh(
        positions,
        triangles.astype(np.int32),
        (uv * [1, -1] + [0, 1]).astype(np.float32),
        np.ones((len(positions), 3), np.float32) if colours is None else colours,
        _texture_index(face, faces, len(textures)),
        textures,
    )


def _together(columns: _Columns, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    """`(rows, len(names))` of single values; None where one of them is missing."""
    if any(name not in columns or (columns[name].lengths != 1).any() for name in names):
        return None
    return np.stack([columns[name].values.astype(np.float64) for name in names], axis=1)


def _colours(columns: _Columns) -> NDArray[np.float32] | None:
    """`(rows, 3)` in [0, 1]: whole numbers are shares of 255, or of 65535 if one is greater; floats of 1, or of 255."""
    for names in _COLOURS:
        stored = _together(columns, names)
        if stored is not None and len(stored):
            integer, highest = columns[names[0]].integer, stored.max()
            stored = np.where((stored < 0) & integer, stored + 256, stored)  # Bytes that were declared with a sign.
            whole = (65535 if highest > 255 else 255) if integer else (255 if highest > 2 else 1)
            return np.clip(stored / whole, 0, 1).astype(np.float32)
    return None


def _wedges(face: _Columns, listed: _Column, corners: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """`(3 t, 2)` texture coordinates of the triangles' corners; None where not every corner has some."""
    found = face.get("texcoord")
    if found is None or (found.lengths != 2 * listed.lengths).any():
        return None
    return found.values.astype(np.float64).reshape(-1, 2)[corners].reshape(-1, 2)


def _texture_index(face: _Columns, faces: NDArray[np.int64], textures: int) -> NDArray[np.int32]:
    """`(t,)` the texture that a face names, which is the first one where it names none."""
    if not textures or "texnumber" not in face:
        return np.full(len(faces), 0 if textures else -1, np.int32)
    named = face["texnumber"].values.astype(np.int64)[faces]
    return np.where((named >= 0) & (named < textures), named, -1).astype(np.int32)


def _warn_of_unread_colours(files: SceneFiles, properties: list[str], pictures: list[str]) -> None:
    if names := [name for name in properties if _COLOUR_LIKE.search(name)]:
        known = ", ".join("/".join(each) for each in _COLOURS)
        warn_once(str(files.path), f"is shown white: its {', '.join(names)} are not followed (known are {known})")
    elif pictures:
        warn_once(str(files.path), f"is shown white: it names {', '.join(pictures)}, but has no texture coordinates")
