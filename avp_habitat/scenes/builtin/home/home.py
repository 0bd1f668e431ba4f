"""Furnished homes that are made up from a number, `builtin-home:SEED`: rooms with doorways between them."""

from functools import partial

from avp_habitat.errors import SceneError
from avp_habitat.scenes.builtin import finishes
from avp_habitat.scenes.builtin.furnish import Placed
from avp_habitat.scenes.builtin.home.fill import WALKABLE, furnish_home
from avp_habitat.scenes.builtin.home.plan import MOST_ROOMS, Room, plan_home
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.noise import Random, blend, shade
from avp_habitat.scenes.builtin.room import lit_room
from avp_habitat.scenes.builtin.shapes import Material
from avp_habitat.scenes.mesh import TexturedMesh, merge

HOME_VERSION = 2
"""Rises whenever a seed's home changes, so that results name the home that they were measured in."""
_TRIES = 40
_STREAMS = 1 << 20
"""Where the streams of random numbers begin that homes draw from; rooms have those below."""


def _kits(seed: int, rng: Random, rooms: list[Room]) -> list[Kit]:
    """What each room is made of: living rooms, kitchens and corridors alike, other rooms in one or two other ways."""
    shared, *others = (Kit(rng.integer(0, 1 << 40)) for _ in range(2 if len(rooms) < 5 else 3))
    kits, private = [], 0
    for index, room in enumerate(rooms):
        kit = shared
        if room.use in ("bedroom", "study", "bath"):
            kit, private = others[private % len(others)], private + 1
        kits.append(kit.variant(index + 1, **_surfaces(Random(seed, _STREAMS + 100 + index), kit, room.use)))
    return kits


def _surfaces(rng: Random, kit: Kit, use: str) -> dict[str, Material]:
    """Walls painted for this room alone; in kitchens and baths tiles on the floor, in baths on the walls too."""
    scheme = kit.scheme
    tint = blend(scheme.wall, rng.choice((*scheme.accents, scheme.feature)), rng.uniform(0.0, 0.35))
    found = {"wall": Material(partial(finishes.plaster, rng.spawn(), tint), 1.8, 1.8)}
    if use in ("kitchen", "bath"):
        base, ink = blend(shade(scheme.wall, 0.9), scheme.feature, 0.12), blend(scheme.feature, (0.3, 0.3, 0.35), 0.4)
        floor = partial(finishes.tiles, rng.spawn(), base, ink, patterned=rng.chance(0.6))
        found["floor"] = Material(floor, 1.5, 1.5)
        if use == "bath":
            tiles = partial(finishes.tiles, rng.spawn(), shade(scheme.wall, 0.96), ink, patterned=False)
            found["wall"] = found["papered_wall"] = Material(tiles, 1.5, 1.5)
    return found


def plan_furnished(seed: int) -> tuple[list[Room], list[Kit], list[list[Placed]]]:
    """The rooms of a home, what each is made of, and its furniture, before light is baked.

    Raises:
        SceneError: no plan came to a home of 30 to 150 m² with doorways to every room and enough walkable floor.
    """
    count = Random(seed, _STREAMS).integer(2, MOST_ROOMS)
    for attempt in range(_TRIES):
        rng = Random(seed, _STREAMS + 1000 + attempt)
        rooms = plan_home(rng, count)
        if rooms is None:
            continue
        kits = _kits(seed, rng, rooms)
        placed, walkable = furnish_home(rooms, rng, kits)
        if walkable >= WALKABLE:
            return rooms, kits, placed
    raise SceneError(
        f"builtin-home:{seed}: expected a home with a way to every room, but none of {_TRIES} plans gave one; "
        "take another seed"
    )


def generate_home(seed: int) -> TexturedMesh:
    """A furnished home: metres, Y up, floor at y = 0, closed on all sides, the same for the same seed of 0 or more.

    Raises:
        SceneError: none could be made.
    """
    rooms, kits, placed = plan_furnished(seed)
    parts = []
    for index, (room, kit, stands) in enumerate(zip(rooms, kits, placed, strict=True)):
        parts += lit_room(kit, Random(seed, _STREAMS + 500 + index), room.shell, stands)
    return merge(parts)
