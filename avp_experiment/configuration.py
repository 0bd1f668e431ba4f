"""What an experiment consists of: methods, scenes, and a preset for each kind of machine and purpose."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avp_habitat import plugins
from avp_habitat.errors import UsageError, unknown_name
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.rewards import REWARDS

TRAIN, UNSEEN = "train", "unseen"
"""Roles of scenes: policies are trained in the former, never in the latter."""
ROOMS = "_rooms"
"""A learned method whose name ends so is trained in generated rooms, never in the scenes of the experiment."""
TUNED = "_tuned"
"""The weights of an exported policy whose name ends so are trained further in the scenes of the experiment."""
_FIRST_ROOM = 100


@dataclass(frozen=True)
class Method:
    """A way to take views: a policy, or what a policy learns from a reward."""

    spec: str
    """The policy or reward: its name or `module:object`."""
    learned: bool = False
    """It is a reward."""
    in_rooms: bool = False
    """Trained in generated rooms, never in the scenes of the experiment."""
    tuned: bool = False
    """It is an exported policy, which is trained further in the scenes."""

    @property
    def name(self) -> str:
        """In files and tables."""
        ending = (ROOMS if self.in_rooms else "") + (TUNED if self.tuned else "")
        return self.spec.strip("./").replace(":", ".").replace("/", ".") + ending

    @property
    def reward(self) -> str:
        """What it learns, or its weights learned, from; of a baseline, which has no use for it, one without a stop."""
        from avp_habitat.policies.registry import learned_reward

        return self.spec if self.learned and not self.tuned else learned_reward(self.spec) or "coverage"


def known_methods() -> dict[str, Method]:
    """By name: policies, rewards, rewards trained in rooms; also those that other distributions register."""
    from avp_habitat.policies.registry import POLICIES

    rewards = plugins.names("avp.rewards", REWARDS)
    methods = [Method(name) for name in plugins.names("avp.policies", POLICIES)]
    methods += [Method(reward, learned=True, in_rooms=rooms) for rooms in (False, True) for reward in rewards]
    return {method.name: method for method in methods}


BASELINES = ("heuristic", "random", "frontier", "greedy", "nbv", "oracle", "survey")
"""What learned policies are compared with by default; the last two plan with full knowledge."""
DEFAULT = (*BASELINES, *REWARDS, f"proposed{ROOMS}", f"surface{ROOMS}", "pretrained")
"""The baselines, every reward, rewards trained over many rooms, and the weights of the package."""


def chosen_methods(names: Sequence[str]) -> tuple[Method, ...]:
    """The methods of these names, each once: known ones in their order, then exported policies and `module:object`.

    The names of exported policies may end in `_tuned`. `module:object` is a class or object with `predict`, or else a
    reward, whose name may end in `_rooms`.
    """
    from avp_habitat.policies.registry import exported_file

    if not names:
        raise UsageError("methods: expected at least one, got none")
    known = known_methods()
    # In this order: a folder may be called like a reward.
    unknown = [name for name in names if name not in known]
    exported = dict.fromkeys(name for name in unknown if exported_file(name.removesuffix(TUNED)) is not None)
    for name in names:
        if ":" not in name and name not in known and name not in exported:
            raise unknown_name("method", name, known)
    chosen = [method for name, method in known.items() if name in names]
    for name in exported:
        tuned = name.endswith(TUNED)
        chosen.append(Method(name.removesuffix(TUNED), learned=tuned, tuned=tuned))
    for name in dict.fromkeys(name for name in names if ":" in name and name not in exported):
        spec = name.removesuffix(ROOMS)
        learned = not hasattr(plugins.find("avp.policies", spec, {}), "predict")
        chosen.append(Method(spec, learned, in_rooms=learned and name != spec))
    return tuple(chosen)


def without_label(method: str) -> str:
    """The name of a method whose row of merged results is called `METHOD (LABEL)`."""
    return method.partition(" (")[0]


@dataclass(frozen=True)
class ExperimentPreset:
    """Everything about an experiment but its scenes, methods and simulator."""

    steps: int
    """Environment steps of a training in the scenes."""
    steps_rooms: int
    """Environment steps of a training in generated rooms."""
    seeds: int = 3
    """Trainings of each reward, and places to start from."""
    starts: int = 1
    """Episodes of each method, scene and seed."""
    observation: str = "map"
    """What the policies observe; `map` becomes what the reward `surface` needs for that reward."""
    rooms: int = 16
    size: tuple[int, int] = (640, 480)
    """Width and height of the pictures in pixels."""
    reconstruction: str = "avp-nerfacto"
    """nerfstudio's method."""
    iterations: int = 30_000
    prefixes: tuple[int, ...] = (20, 40, 60)
    """Each episode is also reconstructed from its first so many frames."""
    budget: int = 80
    """T: most views of an episode."""
    heldout_pictures: tuple[int, ...] = (3, 11, 16)
    """Held-out views whose renders are kept."""


PRESETS = {
    "demo": ExperimentPreset(100_000, 100_000, seeds=1, rooms=2, size=(192, 144), iterations=1000, prefixes=()),
    "smoke": ExperimentPreset(24_576, 24_576, seeds=1, rooms=2, size=(96, 72), iterations=100, prefixes=(40,)),
    "cpu": ExperimentPreset(700_000, 700_000, size=(192, 144), iterations=300, prefixes=(20, 40)),
    "gpu": ExperimentPreset(1_000_000, 2_000_000, starts=3),
    "paper": ExperimentPreset(300_000, 300_000, observation="numbers", reconstruction="nerfacto"),
}
"""demo: one short training, no curves (`make demo`). smoke: minutes, to see that everything works. cpu: two to three
hours on two cores. gpu: the same questions at full size. paper: the paper's observation, steps and reconstruction."""


@dataclass(frozen=True)
class ExperimentScene:
    """A scene: as the user named it, and its name without folders."""

    spec: str
    name: str
    sha256: str
    role: str
    """`TRAIN` or `UNSEEN`."""


def scene_slug(name: str) -> str:
    """A scene's name for files: `white_room` of `white_room.glb`, `builtin_0` of `builtin:0`."""
    return Path(name).stem.replace(":", "_")


@dataclass(frozen=True)
class Configuration:
    """An experiment."""

    preset_name: str
    preset: ExperimentPreset
    """Its values, some of them perhaps replaced by the user."""
    scenes: tuple[ExperimentScene, ...]
    """Of training first, then unseen ones."""
    methods: tuple[Method, ...]
    metrics: tuple[str, ...] = ()
    """Of the user, by name or `module:function`."""
    simulator: str = "raycast"
    up: str | None = None
    """Axis of mesh files that points up; the scenes' digests cover it."""

    @property
    def rooms(self) -> tuple[str, ...]:
        """The generated rooms of the methods that train in such, none of them a scene of the experiment."""
        taken = {scene.name for scene in self.scenes}
        rooms = (f"builtin:{seed}" for seed in itertools.count(_FIRST_ROOM))
        return tuple(itertools.islice((room for room in rooms if room not in taken), self.preset.rooms))

    @property
    def simulator_options(self) -> tuple[str, ...]:
        """Of commands that open a scene."""
        return ("--simulator", self.simulator, *(("--up", self.up) if self.up else ()))

    def as_json(self) -> dict[str, Any]:
        """Scenes, preset and its values as the results state them."""
        values = asdict(self.preset)
        width, height = values.pop("size")
        values |= {name: list(values[name]) for name in ("prefixes", "heldout_pictures")}
        values |= {"rooms": list(self.rooms), "width": width, "height": height}
        values |= {"metrics": list(self.metrics)} if self.metrics else {}
        scenes = [{"name": scene.name, "sha256": scene.sha256, "role": scene.role} for scene in self.scenes]
        return {"preset": self.preset_name, **values, "simulator": self.simulator, "scenes": scenes}


def read_scenes(train: Sequence[str], unseen: Sequence[str], choice: SimulatorChoice) -> tuple[ExperimentScene, ...]:
    """Open every scene once, so that one that cannot be used is named before anything long begins."""
    if not train:
        raise UsageError("scene: expected at least one scene of training, got none")
    found: list[ExperimentScene] = []
    for role, specs in ((TRAIN, train), (UNSEEN, unseen)):
        for spec in specs:
            opened = open_simulator(choice, spec)
            _ = opened.area
            scene = ExperimentScene(spec, opened.scene, opened.scene_digest, role)
            opened.close()
            for other in found:
                if scene.sha256 == other.sha256 or scene_slug(scene.name) == scene_slug(other.name):
                    same = "the same scene as" if scene.sha256 == other.sha256 else "named as"
                    raise UsageError(f"{spec}: {same} {other.spec}, given as {other.role}; expected each name once")
            found.append(scene)
    return tuple(found)
