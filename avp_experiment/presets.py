"""How much is done for an experiment: one preset for each kind of machine and purpose."""

from dataclasses import dataclass

from avp_habitat.errors import unknown_name

Size = tuple[int, int]


@dataclass(frozen=True)
class Preset:
    """Everything about an experiment but its scenes, methods and seeds."""

    seeds: int
    """Trainings of each reward, and places to start from, unless the user asks for another number."""
    starts: int
    """Episodes of each method, scene and seed, unless the user asks for another number."""
    observation: str
    """What the policies observe; `map` becomes what the reward `surface` needs for that reward."""
    steps: int
    """Environment steps of a training in the scenes."""
    steps_rooms: int
    """Environment steps of a training in generated rooms."""
    rooms: int
    """How many generated rooms."""
    size: Size
    """Width and height of the pictures in pixels."""
    reconstruction: str
    """nerfstudio's method."""
    iterations: int
    """Of each reconstruction."""
    prefixes: tuple[int, ...]
    """Each episode is also reconstructed from its first so many frames."""
    budget: int = 80
    """T: most views of an episode."""
    heldout_pictures: tuple[int, ...] = (3, 11, 16)
    """Held-out views whose renders are kept."""


PRESETS = {
    "smoke": Preset(
        seeds=1,
        starts=1,
        observation="map",
        steps=24_576,
        steps_rooms=24_576,
        rooms=2,
        size=(96, 72),
        reconstruction="avp-nerfacto",
        iterations=100,
        prefixes=(40,),
    ),
    "cpu": Preset(
        seeds=3,
        starts=1,
        observation="map",
        steps=700_000,
        steps_rooms=700_000,
        rooms=16,
        size=(192, 144),
        reconstruction="avp-nerfacto",
        iterations=300,
        prefixes=(20, 40),
    ),
    "gpu": Preset(
        seeds=3,
        starts=3,
        observation="map",
        steps=1_000_000,
        steps_rooms=2_000_000,
        rooms=16,
        size=(640, 480),
        reconstruction="avp-nerfacto",
        iterations=30_000,
        prefixes=(20, 40, 60),
    ),
    "paper": Preset(
        seeds=3,
        starts=1,
        observation="numbers",
        steps=300_000,
        steps_rooms=300_000,
        rooms=16,
        size=(640, 480),
        reconstruction="nerfacto",
        iterations=30_000,
        prefixes=(20, 40, 60),
    ),
}
"""smoke: minutes, to see that everything works. cpu: two to three hours on two cores. gpu: the same questions at full
size. paper: the paper's observation, steps and reconstruction."""


def preset_named(name: str) -> Preset:
    """The preset of a name.

    Raises:
        UsageError: there is none; the text names the nearest one.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]
