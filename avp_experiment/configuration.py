"""What an experiment's figures depend on, kept beside them so that a folder never mixes two experiments."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avp_experiment.presets import Preset
from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.policies.registry import POLICY_NAMES
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.rewards import REWARD_NAMES

ROOMS = "_rooms"
"""A learned method whose name ends so is trained in generated rooms, never in the scenes of the experiment."""
_WITHOUT_STOP = "coverage"


@dataclass(frozen=True)
class Method:
    """A way to take views."""

    name: str
    """In files and tables."""
    reward: str
    """What it learns from; of a baseline, which has no use for it, one without a stop."""
    learned: bool
    """Whether it is trained."""
    rooms: bool = False
    """Whether it is trained in generated rooms."""


METHODS = {
    name: Method(name, _WITHOUT_STOP, learned=False) for name in POLICY_NAMES
} | {
    reward + suffix: Method(reward + suffix, reward, learned=True, rooms=bool(suffix))
    for suffix in ("", ROOMS)
    for reward in REWARD_NAMES
}  # fmt: skip
"""By name."""
BASELINES = ("heuristic", "random", "frontier", "greedy", "oracle", "survey")
"""What learned policies are compared with by default; the last two plan with full knowledge, for floor and for all
surfaces."""
DEFAULT = (*BASELINES, *REWARD_NAMES, f"proposed{ROOMS}", f"surface{ROOMS}")
"""The baselines, every reward, and the rewards with a learned stop trained over many rooms."""


def chosen_methods(names: Iterable[str]) -> tuple[Method, ...]:
    """The methods of these names, in the order of `METHODS`' tables.

    Raises:
        UsageError: no such method, with the nearest name, or none at all.
    """
    names = list(names)
    for name in names:
        if name not in METHODS:
            raise unknown_name("method", name, METHODS)
    if not names:
        raise UsageError("methods: expected at least one, got none")
    return tuple(METHODS[name] for name in in_order(names))


def in_order(names: Iterable[str]) -> Sequence[str]:
    """Each name once: baselines first, then rewards, then those trained in rooms."""
    wanted = set(names)
    return [name for name in METHODS if name in wanted]


FORMAT = 1
FILE = "experiment.json"
_FIRST_ROOM = 100


@dataclass(frozen=True)
class Scene:
    """A scene of the experiment."""

    spec: str
    """As the user named it."""
    name: str
    """Without folders."""
    sha256: str
    """Of its content."""
    role: str
    """`train`: policies are trained in it. `unseen`: they are not."""

    @property
    def slug(self) -> str:
        """The name for files."""
        return scene_slug(self.name)


def scene_slug(name: str) -> str:
    """A scene's name for files: `white_room.glb` becomes `white_room`, `builtin:0` becomes `builtin_0`."""
    return Path(name).stem.replace(":", "_")


@dataclass(frozen=True)
class Configuration:
    """An experiment."""

    preset_name: str
    """Of the preset."""
    preset: Preset
    """Its values."""
    seeds: int
    """Trainings of each reward."""
    scenes: tuple[Scene, ...]
    """Of training first, then unseen ones."""
    methods: tuple[Method, ...]
    """Compared."""
    simulator: str = "raycast"
    """The simulator's name."""
    up: str | None = None
    """Axis of mesh files that points up; the scenes' digests cover it."""

    @property
    def rooms(self) -> tuple[str, ...]:
        """The generated rooms of the methods that train in such, none of them a scene of the experiment."""
        taken = {scene.name for scene in self.scenes}
        seeds = range(_FIRST_ROOM, _FIRST_ROOM + self.preset.rooms + len(taken))
        return tuple([room for seed in seeds if (room := f"builtin:{seed}") not in taken][: self.preset.rooms])

    @property
    def simulator_options(self) -> tuple[str, ...]:
        """The options of commands that open a scene."""
        return ("--simulator", self.simulator, *(("--up", self.up) if self.up else ()))

    def as_json(self) -> dict[str, Any]:
        """Scenes, preset and its values as the results state them."""
        scenes = [{"name": scene.name, "sha256": scene.sha256, "role": scene.role} for scene in self.scenes]
        values = asdict(self.preset)
        width, height = values.pop("size")
        values |= {name: list(values[name]) for name in ("prefixes", "heldout_pictures")}
        values |= {"rooms": list(self.rooms), "seeds": self.seeds, "width": width, "height": height}
        return {"preset": self.preset_name, **values, "simulator": self.simulator, "scenes": scenes}


def read_scenes(train: Sequence[str], unseen: Sequence[str], choice: SimulatorChoice) -> tuple[Scene, ...]:
    """Open every scene once, so that one that cannot be used is named before anything long begins.

    Raises:
        UsageError: no scene of training, one given twice, or a name that cannot be right.
        AVPError: a scene cannot be read, or nobody can stand in it.
    """
    if not train:
        raise UsageError("scene: expected at least one scene of training, got none")
    found: list[Scene] = []
    for role, specs in (("train", train), ("unseen", unseen)):
        for spec in specs:
            opened = open_simulator(choice, spec)
            _ = opened.area
            scene = Scene(spec, opened.scene, opened.scene_digest, role)
            opened.close()
            for other in found:
                _check_different(scene, other)
            found.append(scene)
    return tuple(found)


def _check_different(scene: Scene, other: Scene) -> None:
    if scene.sha256 == other.sha256:
        raise UsageError(
            f"{scene.spec}: the same scene as {other.spec}, given as {other.role}; expected each scene once"
        )
    if scene.slug == other.slug:
        raise UsageError(f"{scene.spec}: has the same name as {other.spec}; expected scenes of different names")


def keep(configuration: Configuration, folder: Path) -> None:
    """Write the configuration into the experiment's folder, or hold it against the one that is there.

    Raises:
        UsageError: the folder holds something else, or an experiment of another configuration.
        AVPError: nothing can be written there.
    """
    path, wanted = folder / FILE, _fixed(configuration.as_json())
    if path.exists():
        known = _fixed(_known(path))
        if different := sorted(name for name in {*wanted, *known} if wanted.get(name) != known.get(name)):
            raise UsageError(
                f"out: {folder} holds an experiment of another configuration: "
                f"{_differences(different, known, wanted)}; name another folder, or remove it"
            )
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"out: {folder} is no experiment's folder (it has no {FILE}); expected a new or empty folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps({"format": FORMAT, **wanted}, indent=1) + "\n", encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise AVPError(f"out: {folder}: cannot write there: {error.strerror}") from None


def _fixed(values: dict[str, Any]) -> dict[str, Any]:
    """What may not change within a folder; methods and starts may be added."""
    return {name: value for name, value in values.items() if name != "starts"}


def _known(path: Path) -> dict[str, Any]:
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        version = known.pop("format")
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise AVPError(f"{path}: expected an experiment's configuration, could not read it: {error}") from None
    if version != FORMAT:
        raise AVPError(f"{path}: expected format {FORMAT}, found {version!r}")
    return known


def _differences(names: Sequence[str], known: dict[str, Any], wanted: dict[str, Any]) -> str:
    def short(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return ", ".join(f"{one['name']} ({one['role']})" for one in value)
        text = str(value)
        return text if len(text) <= 60 else f"{text[:57]}..."

    return "; ".join(f"{name} {short(known.get(name))} there, {short(wanted.get(name))} asked for" for name in names)
