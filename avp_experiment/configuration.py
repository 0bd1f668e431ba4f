"""What an experiment consists of: methods, scenes, and a preset for each kind of machine and purpose."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avp_habitat import plugins
from avp_habitat.errors import SceneError, UsageError, unknown_name
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.budget import views_for
from avp_habitat.task.rewards import REWARDS

TRAIN, UNSEEN = "train", "unseen"
"""Roles of scenes: policies are trained in the former, never in the latter."""
ROOMS = "_rooms"
"""A learned method whose name ends so is trained in generated rooms, never in the scenes of the experiment."""
TUNED = "_tuned"
"""The weights of an exported policy whose name ends so are trained further in the scenes of the experiment."""
LARGE_M2 = 30.0
"""In a benchmark, scenes with more navigable floor get a budget by area."""
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


_IN_ROOMS = tuple(f"{name}{ROOMS}" for name in ("coverage", "coverage_redundancy", "proposed", "surface", "multiview"))
"""The suite's rewards, named one by one: a benchmark does not change when a reward is added."""
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
class FixedScene:
    """A scene that belongs to a preset, and must be the same for everybody."""

    spec: str
    sha256: str


@dataclass(frozen=True)
class ExperimentPreset:
    """Everything about an experiment but its scenes, methods and simulator."""

    steps: int
    """Environment steps of a training in the scenes."""
    steps_rooms: int
    """Environment steps of a training in generated rooms."""
    seeds: int = 3
    """Trainings of each reward, unless `trainings` says otherwise, and places to start from."""
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
    methods: tuple[str, ...] = DEFAULT
    """Compared where the user names none."""
    trainings: int | None = None
    """So many seeds are trained, whose policies the other seeds' places get in turn; None: every seed."""
    benchmark: bool = False
    """Nothing is trained in the scenes, and neither seeds nor scenes of its own can be exchanged."""
    fixed: tuple[FixedScene, ...] = ()
    """Scenes of its own; the user's come to them."""
    geometry_after: tuple[int, ...] = ()
    """Geometry is also measured of the first so many views."""
    reconstructed: int | None = None
    """So many seeds are reconstructed, the first start of each; None: everything."""
    model_geometry: bool = False
    """Measure the geometry of reconstructions of whole episodes too."""

    def scaled(self, views: int, budget: int) -> int:
        """A number of views, stated for the preset's budget, for that of a scene."""
        return round(views * budget / self.budget)


PRESETS = {
    "demo": ExperimentPreset(100_000, 100_000, seeds=1, rooms=2, size=(192, 144), iterations=1000, prefixes=()),
    "smoke": ExperimentPreset(24_576, 24_576, seeds=1, rooms=2, size=(96, 72), iterations=100, prefixes=(40,)),
    "cpu": ExperimentPreset(700_000, 700_000, size=(192, 144), iterations=300, prefixes=(20, 40)),
    "gpu": ExperimentPreset(1_000_000, 2_000_000, starts=3),
    "paper": ExperimentPreset(300_000, 300_000, observation="numbers", reconstruction="nerfacto"),
    "benchmark-v1": ExperimentPreset(
        0,
        500_000,
        seeds=6,
        trainings=3,
        size=(192, 144),
        iterations=500,
        prefixes=(40,),
        methods=("heuristic", "random", "frontier", "greedy", "nbv", "survey", *_IN_ROOMS, "pretrained"),
        benchmark=True,
        fixed=(
            FixedScene("builtin:100000", "ee50d313178757051cc1d6ff790e608a08a3e9286ae3984a278f5835b0ea292b"),
            FixedScene("builtin:100001", "681cffbd90409622ef82962668bccd2da1d55fc81d29e143557b1d417b9abd9d"),
            FixedScene("builtin-home:100000", "3b9143c7e53eb82b53636ce2ad158f46c692b35b6006e7d682e5c01e92f224b5"),
            FixedScene("builtin-home:100001", "2f767ed80be0d3964437f7d8a018706f1c14d0f599a059c9ad1b7f447ea082f9"),
        ),
        geometry_after=(40,),
        reconstructed=1,
        model_geometry=True,
    ),
    "benchmark-v1-full": ExperimentPreset(
        0,
        500_000,
        seeds=1,
        iterations=6000,
        prefixes=(),
        methods=("heuristic", "greedy", "nbv", "survey", f"proposed{ROOMS}", f"surface{ROOMS}", "pretrained"),
        benchmark=True,
        geometry_after=(20, 40, 60),
        model_geometry=True,
    ),
}
"""demo: one short training, no curves (`make demo`). smoke: minutes, to see that everything works. cpu: two to three
hours on two cores. gpu: the same questions at full size. paper: the paper's observation, steps and reconstruction.
benchmark-v1: what docs/benchmark.md says; a change of any of its values is a new version. benchmark-v1-full: its
reconstructions at full size, ten minutes of a core each."""


@dataclass(frozen=True)
class ExperimentScene:
    """A scene: as the user named it, and its name without folders."""

    spec: str
    name: str
    sha256: str
    role: str
    """`TRAIN` or `UNSEEN`."""
    budget: int = 80
    """T there: most views of an episode."""


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
        preset, scenes = self.preset, []
        values = asdict(preset)
        for name in ("methods", "fixed"):
            del values[name]
        # Experiments of before know none of these.
        for name in ("trainings", "benchmark", "geometry_after", "reconstructed", "model_geometry"):
            if values[name] == getattr(ExperimentPreset, name):
                del values[name]
        width, height = values.pop("size")
        values = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
        values |= {"rooms": list(self.rooms), "width": width, "height": height}
        values |= {"metrics": list(self.metrics)} if self.metrics else {}
        for scene in self.scenes:
            budget = {"budget": scene.budget} if scene.budget != preset.budget else {}
            scenes.append({"name": scene.name, "sha256": scene.sha256, "role": scene.role, **budget})
        return {"preset": self.preset_name, **values, "simulator": self.simulator, "scenes": scenes}


def read_scenes(
    train: Sequence[str], unseen: Sequence[str], choice: SimulatorChoice, preset: ExperimentPreset
) -> tuple[ExperimentScene, ...]:
    """Open every scene once, so that one that cannot be used is named before anything long begins.

    Raises:
        UsageError: no scene where one is needed, or one comes twice.
        SceneError: one cannot be used, or is not the one that the preset names.
    """
    fixed = {scene.spec: scene for scene in preset.fixed}
    unseen = [*fixed, *(spec for spec in unseen if spec not in fixed)]
    if preset.benchmark and train:
        raise UsageError(f"scene: nothing is trained in the scenes of a benchmark; give {', '.join(train)} as unseen")
    if not (unseen if preset.benchmark else train):
        raise UsageError(f"{'unseen' if preset.benchmark else 'scene'}: expected at least one scene, got none")
    found: list[ExperimentScene] = []
    for role, specs in ((TRAIN, train), (UNSEEN, unseen)):
        for spec in specs:
            scene = _scene(spec, role, choice, preset, fixed.get(spec))
            for other in found:
                if scene.sha256 == other.sha256 or scene_slug(scene.name) == scene_slug(other.name):
                    same = "the same scene as" if scene.sha256 == other.sha256 else "named as"
                    raise UsageError(f"{spec}: {same} {other.spec}, given as {other.role}; expected each name once")
            found.append(scene)
    return tuple(found)


def _scene(
    spec: str, role: str, choice: SimulatorChoice, preset: ExperimentPreset, fixed: FixedScene | None
) -> ExperimentScene:
    budget = preset.budget
    opened = open_simulator(choice, spec)
    area_m2 = opened.area.area_m2
    if preset.benchmark and area_m2 > LARGE_M2:
        budget = views_for(area_m2)
    scene = ExperimentScene(spec, opened.scene, opened.scene_digest, role, budget)
    opened.close()
    if fixed and scene.sha256 != fixed.sha256:
        wanted = f"expected the digest {fixed.sha256}, which the benchmark is made with"
        raise SceneError(f"{spec}: {wanted}, found {scene.sha256}: another version makes another scene")
    return scene
