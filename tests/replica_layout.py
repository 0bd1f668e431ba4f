"""Lays a mesh out on disk as Replica lays out its scenes: Z-up quads with vertex colours in `room_0/mesh.ply`."""

import json
from pathlib import Path

import numpy as np

from avp_habitat.scenes.mesh import TexturedMesh

DATASET = "replica.scene_dataset_config.json"


def replica_layout(folder: Path, mesh: TexturedMesh, scene: str = "room_0", *, dataset: bool = False) -> Path:
    """Write a scene of the data set that lies in `folder`.

    Args:
        folder: of the data set.
        mesh: Y up; a vertex of Replica has one colour, so textures come out as coarse as the mesh.
        scene: name of the scene's folder.
        dataset: whether to write the dataset config too.

    Returns:
        The scene's folder.
    """
    room = folder / scene
    habitat = room / "habitat"
    habitat.mkdir(parents=True)
    write_quads(room / "mesh.ply", mesh, z_up=True)
    write_quads(habitat / "mesh_semantic.ply", mesh, z_up=True, object_ids=True)
    (habitat / "info_semantic.json").write_text(json.dumps({"classes": [], "objects": [], "id_to_label": [0]}))
    stage = {
        "render_asset": "../mesh.ply",
        "semantic_descriptor_filename": "info_semantic.json",
        "semantic_asset": "mesh_semantic.ply",
        "nav_asset": "mesh_semantic.navmesh",
    }
    (habitat / "replica_stage.stage_config.json").write_text(json.dumps(stage))
    if dataset:
        default = {"shader_type": "flat", "up": [0, 0, 1], "front": [0, 1, 0]}
        paths = {".json": ["*_[0-9]/habitat/replica_stage.stage_config.json"]}
        (folder / DATASET).write_text(json.dumps({"stages": {"default_attributes": default, "paths": paths}}))
    return room


def write_quads(path: Path, mesh: TexturedMesh, *, z_up: bool, object_ids: bool = False) -> None:
    """Binary PLY: positions, normals, byte colours, faces of four corners; (x, -z, y) of (x, y, z) if `z_up`."""
    columns = [("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)]
    vertices = np.zeros(len(mesh.vertices), columns)
    normals = vertex_normals(mesh)
    for name, values in (("position", mesh.vertices), ("normal", normals)):
        vertices[name] = (values * [1, 1, -1])[:, [0, 2, 1]] if z_up else values
    vertices["colour"] = np.round(255 * vertex_colours(mesh))
    corners = quads(mesh)
    faces = np.zeros(len(corners), [("count", "u1"), ("corners", "<i4", 4)] + [("object", "<i4")] * object_ids)
    faces["count"], faces["corners"] = 4, corners
    floats = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    bytes_ = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{floats}{bytes_}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        f"{'property int object_id' + chr(10) if object_ids else ''}end_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def quads(mesh: TexturedMesh) -> np.ndarray:
    """`(f, 4)` corners: neighbours that share a diagonal are joined; a triangle alone has its last corner twice."""
    found, waiting = [], None
    for triangle in mesh.triangles.tolist():
        shared = set(triangle) & set(waiting or ())
        if waiting and len(shared) == 2 and len(set(triangle)) == len(set(waiting)) == 3:
            # The quad a b c d is split into a b c and c d a by every reader: a and c are the diagonal.
            first = next(i for i in range(3) if waiting[i] not in shared)
            c, a = waiting[(first + 1) % 3], waiting[(first + 2) % 3]
            (d,) = set(triangle) - shared
            found.append([a, waiting[first], c, d])
            waiting = None
            continue
        if waiting:
            found.append([*waiting, waiting[2]])
        waiting = triangle
    if waiting:
        found.append([*waiting, waiting[2]])
    return np.array(found, np.int32)


def vertex_normals(mesh: TexturedMesh) -> np.ndarray:
    """`(v, 3)` unit normals, weighted by area; zero where a vertex has no surface."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.triangles[:, corner], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def vertex_colours(mesh: TexturedMesh) -> np.ndarray:
    """`(v, 3)` colours in [0, 1]: the vertex's own times its texture's pixel."""
    colours = mesh.colours.astype(np.float64)
    for triangle, texture in zip(mesh.triangles, mesh.texture_index, strict=True):
        if texture >= 0:
            picture = mesh.textures[texture]
            height, width = picture.shape[:2]
            column, row = (np.floor(mesh.uv[triangle] * [width, height]).astype(int) % [width, height]).T
            colours[triangle] = mesh.colours[triangle] * picture[row, column] / 255
    return np.clip(colours, 0, 1)
