"""Furnished rooms that are made up from a number: `builtin:SEED`."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from avp_habitat.errors import UsageError
from avp_habitat.scenes.builtin import decor, groups, seating
from avp_habitat.scenes.builtin.floorplan import Floor, Placed, places, stand_at
from avp_habitat.scenes.builtin.groups import Arrange, Member
from avp_habitat.scenes.builtin.kit import Kit, Piece, shifted
from avp_habitat.scenes.builtin.lighting import bake
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Surface, joined
from avp_habitat.scenes.builtin.shell import Shell, Wall, build_shell, plan_shell
from avp_habitat.scenes.mesh import TexturedMesh, merge

GENERATOR_VERSION = 1
"""Rises whenever a seed's room changes, so that results name the room that they were measured in."""
_PICTURES = ((0.9, 0.65), (0.5, 0.7), (0.6, 0.85), (0.7, 0.5), (1.2, 0.8))
"""Widths and heights of frames in metres."""
_MIDDLE_M = 1.6
"""Height at which the middle of a picture hangs."""
_MAIN, _EXTRA, _SMALL = 0.45, 0.42, 0.41
"""Share of the floor that stays walkable after placing main groups, storage, and what fills corners."""
_Spot = tuple[Wall, float, float]
"""A wall, metres along it and metres in front of it."""


def _hang_one(floor: Floor, rng: Random, kit: Kit, wall: Wall, right: float, *, clock: bool) -> bool:
    """Hang a picture or clock at a place on a wall if nothing is in its way."""
    width, height = (0.34, 0.34) if clock else rng.choice(_PICTURES)
    low, high = _MIDDLE_M - height / 2, _MIDDLE_M + height / 2
    stand = stand_at(Member(Piece("", [], width, 0.06, high), 0.0, 0.03), wall, right, 0.0)
    if not floor.is_free(stand, low, high, 0.1):
        return False
    surfaces = decor.clock(kit) if clock else decor.picture(kit, rng, width, height)
    kind = "clock" if clock else "picture"
    piece = Piece(kind, shifted(surfaces, 0.0, _MIDDLE_M, -0.03), width, 0.06, high)
    floor.hang(replace(stand, piece=piece), low, high)
    return True


def _hang_pictures(floor: Floor, rng: Random, kit: Kit) -> None:
    """Pictures on every wall that has room for them, one clock in some rooms."""
    clock = rng.chance(0.6)
    for wall in rng.shuffled(floor.shell.walls):
        wanted = 3 if wall.length > 3 else 1
        for right in rng.shuffled(places(0.5, wall.length - 0.4, 0.2)):
            if wanted and _hang_one(floor, rng, kit, wall, right, clock=clock):
                wanted, clock = wanted - 1, False


def _hang_lamp(floor: Floor, rng: Random, kit: Kit) -> None:
    """A pendant above the dining table, or where the room is open."""
    ceiling, (x0, z0, x1, z1) = floor.shell.ceiling, floor.shell.bounds
    tables = [stand.position for stand in floor.placed if stand.piece.kind == "dining table"]
    bottom = min(2.1, round(ceiling - 0.62, 2))
    piece = decor.pendant(kit, rng, ceiling, bottom)
    half = piece.width / 2
    for x, z in tables or [((x0 + x1) / 2 + 0.1, (z0 + z1) / 2), (x0 + 1.2, z0 + 1.2), (x1 - 1.2, z1 - 1.2)]:
        stand = Placed(piece, np.eye(3), (x, z), (x - half, z - half, x + half, z + half))
        if floor.is_free(stand, bottom - 0.05, ceiling, 0.03):
            floor.hang(stand, bottom - 0.05, ceiling)
            return


def _put(floor: Floor, arrange: Arrange, spots: Iterable[_Spot], least_share: float) -> bool:
    """Place a group at the first spot where it fits and leaves enough of the floor walkable."""
    for wall, right, inwards in spots:
        group = arrange(floor.shell.depth_at(wall, right) - inwards)
        if group is not None and floor.try_group(group, wall, right, inwards, least_share=least_share):
            return True
    return False


def _at_walls(floor: Floor, rng: Random) -> Iterator[_Spot]:
    """Places along all walls in random order."""
    for wall in rng.shuffled(floor.shell.walls):
        for right in rng.shuffled(places(0.3, wall.length - 0.3, 0.2)):
            yield wall, right, 0.0


def _in_corners(floor: Floor, rng: Random, distance: float) -> Iterator[_Spot]:
    """Places at walls, a distance in metres from their ends, in random order."""
    for wall in rng.shuffled(floor.shell.walls):
        for right in rng.shuffled([distance, wall.length - distance]):
            yield wall, right, 0.0


def _anywhere(floor: Floor, rng: Random) -> Iterator[_Spot]:
    """Places in the open floor in random order."""
    for wall in rng.shuffled(floor.shell.walls):
        spots = [(r, i) for r in places(0.6, wall.length - 0.5, 0.3) for i in places(0.1, 4.0, 0.3)]
        for right, inwards in rng.shuffled(spots)[:120]:
            yield wall, right, inwards


def _across(floor: Floor, rng: Random) -> Iterator[_Spot]:
    """Places at long walls, away from their ends, in random order."""
    for wall in rng.shuffled([wall for wall in floor.shell.walls if wall.length >= 3.0]):
        for share in rng.shuffled([0.3, 0.36, 0.43, 0.5, 0.57, 0.64, 0.7]):
            yield wall, round(wall.length * share, 2), 0.0


def _storage(kit: Kit, rng: Random) -> list[Arrange]:
    """Tall and low furniture for walls, the second shelf and chest last."""
    kinds = ((decor.bookshelf, 0.55), (decor.wardrobe, 0.6), (decor.drawers, 0.5))
    first = [groups.against_wall(make(kit, rng), clear) for make, clear in kinds]
    second = [groups.against_wall(make(kit, rng), clear) for make, clear in kinds[::2]]
    return rng.shuffled(first) + second


def _put_living(floor: Floor, rng: Random, kit: Kit) -> bool:
    """Sofa, television and what belongs to them, as much as fits."""
    return any(_put(floor, arrange, _at_walls(floor, rng), _MAIN) for arrange in groups.living(kit, rng))


def _put_main_groups(floor: Floor, rng: Random, kit: Kit) -> None:
    """What the room is for, by its size, and what parts it."""
    area = floor.shell.floor_area
    sleeps = rng.chance(0.6 if area > 22 else 0.4)
    sits = area > 20 or not sleeps
    sits = sits and _put_living(floor, rng, kit)
    sleeps = (sleeps or not sits) and _put(floor, groups.sleeping(kit, rng), _at_walls(floor, rng), _MAIN)
    if not sits and not sleeps:
        sits = _put_living(floor, rng, kit)
    if not (sits and sleeps) or area > 30:
        _put(floor, groups.dining(kit, rng), _anywhere(floor, rng), _MAIN)
    any(_put(floor, arrange, _across(floor, rng), _MAIN) for arrange in groups.divider(kit, rng, floor.shell.ceiling))


def _put_the_rest(floor: Floor, rng: Random, kit: Kit) -> None:
    """Desk, storage, a place to read, and what fills corners, as long as the floor stays walkable."""
    first, *rest = _storage(kit, rng)
    for arrange in (groups.working(kit, rng), first):
        _put(floor, arrange, _at_walls(floor, rng), _EXTRA)
    any(_put(floor, arrange, _at_walls(floor, rng), _EXTRA) for arrange in groups.reading(kit, rng))
    for arrange in rest:
        _put(floor, arrange, _at_walls(floor, rng), _EXTRA)
    for _ in range(2):
        _put(floor, groups.against_wall(decor.plant(kit, rng), 0.0), _in_corners(floor, rng, 0.42), _SMALL)
    if sum(stand.piece.kind == "side table" for stand in floor.placed) < 2:
        _put(floor, groups.against_wall(seating.side_table(kit, rng), 0.3), _at_walls(floor, rng), _SMALL)


def furnish(shell: Shell, rng: Random, kit: Kit) -> list[Placed]:
    """Furniture of a room, none of it in another's place, the door free, the floor walkable and in one part."""
    floor = Floor(shell)
    _put_main_groups(floor, rng, kit)
    _put_the_rest(floor, rng, kit)
    _hang_lamp(floor, rng, kit)
    _hang_pictures(floor, rng, kit)
    return floor.placed


def plan_room(seed: int) -> tuple[Kit, Shell, list[Placed]]:
    """What a room is made of, the empty room and its furniture, before light is baked.

    Args:
        seed: 0 or greater.

    Raises:
        UsageError: the seed is not a whole number of 0 or greater.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise UsageError(f"builtin:{seed}: expected a whole number of 0 or greater as the room's seed, got {seed!r}")
    seed = int(seed)
    kit, shell = Kit(seed), plan_shell(Random(seed, 1))
    return kit, shell, furnish(shell, Random(seed, 2), kit)


def _snapped(values: np.ndarray) -> np.ndarray:
    """Rounded to whole 2^-13 (0.12 mm), so that the last bits of a platform's sine do not matter.

    A power of two, because sums of decimal lengths then never lie half-way between two steps.
    """
    return np.rint(values * 8192) / 8192


def _mesh(surface: Surface, colours: np.ndarray) -> TexturedMesh:
    """A surface as the renderers take it."""
    return TexturedMesh(
        surface.vertices.astype(np.float32),
        surface.triangles.astype(np.int32),
        surface.uv.astype(np.float32),
        (np.rint(colours * 255) / 255).astype(np.float32),
        np.zeros(len(surface.triangles), np.int32),
        [surface.material.picture],
    )


def generate_room(seed: int) -> TexturedMesh:
    """A furnished room: metres, Y up, floor at y = 0, closed on all sides, the same for the same seed.

    Args:
        seed: 0 or greater; decides outline, height, colours, furniture and textures.

    Raises:
        UsageError: the seed is not a whole number of 0 or greater.
    """
    kit, shell, placed = plan_room(seed)
    surfaces = build_shell(kit, Random(int(seed), 3), shell)
    for stand in placed:
        surfaces += stand.surfaces()
    lamps = [lamp for stand in placed for lamp in stand.lamps()]
    surfaces = [replace(s, vertices=_snapped(s.vertices), uv=_snapped(s.uv)) for s in joined(surfaces)]
    colours = bake(shell, surfaces, lamps)
    return merge([_mesh(surface, colour) for surface, colour in zip(surfaces, colours, strict=True)])
