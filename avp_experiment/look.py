"""How pictures of the experiment look: one colour and marker for each method, and files of modest size."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from avp_experiment.configuration import ROOMS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 120
WIDTH_IN = 9.6
"""Of a picture: 1150 pixels."""
_MOST_BYTES = 290_000


@dataclass(frozen=True)
class Look:
    """Of one method, the same in all pictures."""

    colour: str
    """Of its lines and points."""
    marker: str
    """Of its points."""
    line: str = "-"
    """Dashed where it was trained in generated rooms."""
    filled: bool = True
    """Whether its points are; hollow where it was trained in generated rooms."""


# Colours of Okabe and Ito (https://jfly.uni-koeln.de/color/), which people with colour blindness can tell apart, with a
# dark purple and greys beside them; markers differ too.
_LOOKS = {
    "heuristic": Look("#000000", "X"),
    "random": Look("#8C8C8C", "v"),
    "spin": Look("#BBBBBB", "<"),
    "survey": Look("#5F5F5F", ">"),
    "frontier": Look("#E69F00", "s"),
    "greedy": Look("#CC79A7", "D"),
    "oracle": Look("#009E73", "P"),
    "coverage": Look("#56B4E9", "^"),
    "coverage_redundancy": Look("#0072B2", "p"),
    "proposed": Look("#D55E00", "o"),
    "surface": Look("#661F77", "h"),
}
_OTHER = Look("#A08060", "8")


def look_of(method: str) -> Look:
    """The look of a method; one trained in generated rooms has its reward's colour, dashed and hollow."""
    found = _LOOKS.get(method.removesuffix(ROOMS), _OTHER)
    return Look(found.colour, found.marker, "--", filled=False) if method.endswith(ROOMS) else found


def new_figure(height_in: float) -> "Figure":
    """An empty picture of the common width."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def save(picture: "Figure", path: Path) -> None:
    """Write a PNG; one with photographs gets fewer colours, then fewer pixels, until it has a modest size."""
    drawn = io.BytesIO()
    picture.savefig(drawn, dpi=_DPI, format="png")
    content = drawn.getvalue()
    image, scale = Image.open(drawn).convert("RGB"), 1.0
    while len(content) > _MOST_BYTES and scale > 0.3:
        size = (round(image.width * scale), round(image.height * scale))
        smaller = image.resize(size, Image.Resampling.LANCZOS) if scale < 1 else image
        written = io.BytesIO()
        smaller.quantize(256, dither=Image.Dither.NONE).save(written, format="PNG", optimize=True)
        content, scale = written.getvalue(), scale * 0.88
    path.write_bytes(content)
