"""The material libraries (MTL) of Wavefront OBJ files, as far as they tell the colour of surfaces."""

from dataclasses import dataclass, field

_MOST = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
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
        values, rest = _values(more[0] if more else "", _MOST.get(option))
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
