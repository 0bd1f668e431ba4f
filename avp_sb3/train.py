"""`python -m avp_sb3.train`: train a viewpoint policy with Stable-Baselines3's PPO and the suite's callbacks."""

import shlex
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import psutil
from tyro.conf import arg

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.files import check_writable
from avp_habitat.metrics import METRICS_HELP
from avp_habitat.policies.registry import TRUSTED, check_policy, learned_reward, load_model
from avp_habitat.policies.saved_model import is_normalised, load_statistics, statistics_of
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.rewards import REWARDS_HELP, find_reward, stops_always
from avp_habitat.task.settings import OBSERVATIONS_HELP, TaskSettings
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_sb3.exchange.sb3 import note_training, start_file, start_observation, started_ppo
from avp_sb3.presets import MAP, PRESETS, PPOPreset
from avp_sb3.vec_env.pool import TURNOVER, describe

FIRST_SEED, _ROOMS_END = 1000, 100_000
"""Of the generated rooms and homes to train in; those from 100,000 on are for tests."""
_GENTLER = 5
"""The learning rate is that much lower where a training starts from weights, which a few wild steps would spoil."""
_PROCESS_GIB, _SCENE_GIB = 1.2, 0.05
"""About what a process with everything imported takes, and what each open room or home of a pool adds to it."""
_MLFLOW = "runs:/"
_MOST = 1e12


@dataclass(frozen=True)
class Train:
    """Train a viewpoint policy with Stable-Baselines3's PPO and the suite's callbacks.

    300,000 steps of 64 agents take about a minute on two CPU cores with the numbers.
    """

    scene: Annotated[tuple[str, ...], arg(help=f"{SCENES}; agents share several (omitted: builtin:0)")] = ()
    rooms: Annotated[int, Range(0, _ROOMS_END - FIRST_SEED)] = 0
    """So many generated rooms, builtin:1000, builtin:1001, …, beside the scenes."""
    homes: Annotated[int, Range(0, _ROOMS_END - FIRST_SEED)] = 0
    """So many generated homes, builtin-home:1000, builtin-home:1001, …, beside the scenes."""
    open_scenes: Annotated[int, Range(1, _MOST)] = 8
    """With rooms or homes: so many scenes are open at a time, over all workers."""
    turnover: Annotated[int, Range(1, _MOST)] = TURNOVER
    """With rooms or homes: a scene is held for the steps of so many whole episodes."""
    reward: Annotated[str | None, arg(help=f"{REWARDS_HELP} (omitted: proposed, or that of --start)")] = None
    observation: Annotated[
        str | None,
        arg(help=f"{OBSERVATIONS_HELP}; also chooses PPO's settings (omitted: numbers, or that of --start)"),
    ] = None
    metrics: Annotated[tuple[str, ...], arg(help=METRICS_HELP)] = ()
    steps: Annotated[int, Range(1, _MOST)] = 300_000
    """Environment steps in total."""
    agents: int | None = None
    """Agents stepped as one batch (omitted: the settings' own)."""
    workers: int | None = None
    """Processes with simulators of their own: with rooms or homes any number, else a multiple of the scenes'."""
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scenes."""
    rays: bool = False
    """Cast all rays instead of looking views up in the scenes' tables; always so with rooms or homes, which are left
    before tables would pay."""
    width: int | None = None
    """Of the policy's depth image in pixels (omitted: 160; 16 with rooms or homes)."""
    height: int | None = None
    """Of the policy's depth image in pixels (omitted: 120; 12 with rooms or homes)."""
    seed: int = 0
    """Of the policy and the starts."""
    out: Path = Path("runs/ppo.zip")
    """The model; also written after Ctrl-C."""
    resume: Annotated[str | None, arg(metavar="MODEL")] = None
    """Go on until --steps are done with a model: a file, or MLflow's runs:/RUN_ID/model.zip."""
    start: Annotated[str | None, arg(metavar="POLICY")] = None
    """Begin with the weights of a policy: pretrained, another name of `python -m avp_sb3.pretrained`, or the folder of
    one that `python -m avp_sb3.export` wrote; with a fifth of the learning rate."""
    imitate: Annotated[str | None, arg(metavar="POLICY")] = None
    """Imitate a policy first, survey-multiview for example, which plans with full knowledge of the scenes."""
    demonstrations: Annotated[int, Range(8, _MOST)] = 42
    """With --imitate: so many episodes of that policy."""
    trusted: Annotated[bool, arg(help=TRUSTED)] = False
    eval_scene: Annotated[tuple[str, ...] | None, arg(metavar="SCENE")] = None
    """Evaluate in these too, and keep the best model."""
    eval_every: Annotated[int, Range(1, _MOST)] = 150_000
    """Environment steps between two evaluations."""
    recording: Path | None = None
    """The Rerun recording (.rrd) of some episodes; none when omitted."""
    experiment: Annotated[str | None, arg(help=f"MLflow's (omitted: {DEFAULT_HELP})")] = None
    run_name: str | None = None
    """Of the MLflow run (omitted: algorithm, reward, scene and seed)."""

    def __post_init__(self) -> None:
        """Refuse what cannot be right."""
        hold_ranges(self)
        if self.start is not None and self.resume is not None:
            raise UsageError("start: expected one of --start and --resume, got both")
        if self.imitate is not None:
            if self.start is not None or self.resume is not None:
                raise UsageError("imitate: expected no --start or --resume beside it: these have learned already")
            check_policy(self.imitate)
        # Both are known from here on, so that nothing else asks where they came from.
        kind, reward = self.observation or "numbers", TaskSettings.reward
        if self.start is not None:
            kind = start_observation(self.start, self.observation)
            reward = learned_reward(str(start_file(self.start))) or reward
        object.__setattr__(self, "observation", kind)
        object.__setattr__(self, "reward", self.reward or reward)
        _ = self.settings, self.preset

    @property
    def scenes(self) -> list[str]:
        """All that were asked for."""
        seeds = {"builtin": self.rooms, "builtin-home": self.homes}
        made = [f"{kind}:{FIRST_SEED + number}" for kind, count in seeds.items() for number in range(count)]
        return [*self.scene, *made] or ["builtin:0"]

    @property
    def preset(self) -> PPOPreset:
        """PPO's settings; the buffer is shared by as many agents as asked for."""
        preset = PRESETS.get(str(self.observation), MAP)
        buffer = preset.n_envs * preset.n_steps
        agents = preset.n_envs if self.agents is None else self.agents
        if agents < 1 or buffer % agents:
            raise UsageError(f"agents: expected a divisor of PPO's buffer of {buffer} steps, got {agents}")
        return replace(preset, n_envs=agents, n_steps=buffer // agents)

    @property
    def settings(self) -> TaskSettings:
        """Of the task."""
        return TaskSettings(
            reward=str(self.reward),
            observation=self.observation,
            metrics=self.metrics,
            lookup=not (self.rays or self.pooled) and self.simulator.single_rays,
            width=self.width or (16 if self.pooled else 160),
            height=self.height or (12 if self.pooled else 120),
        )

    @property
    def pooled(self) -> bool:
        """Whether the scenes come and go."""
        return self.rooms + self.homes > 0


def check_memory(options: Train) -> None:
    """Refuse a pool that plainly does not fit: the system would end the training without a word.

    Raises:
        UsageError: the machine has too little free memory for so many workers and open scenes.
    """
    processes = 1 + (options.workers or 0)
    scenes = min(options.open_scenes, len(options.scenes))
    needed, free = _PROCESS_GIB * processes + _SCENE_GIB * scenes, psutil.virtual_memory().available / 2**30
    if options.pooled and needed > free:
        raise UsageError(
            f"open-scenes, workers: {scenes} scenes in {processes} processes need about {needed:.1f} GiB of memory, "
            f"{free:.1f} GiB are free; expected fewer"
        )


def _environment(options: Train) -> Any:
    """The agents in this process, or in several: when asked for, and where each scene needs its own simulator."""
    from stable_baselines3.common.vec_env import VecMonitor

    from avp_sb3 import AVPSubprocVecEnv, AVPVecEnv

    choice, scenes = options.simulator, options.scenes
    common = {"agents": options.preset.n_envs, "settings": options.settings, "seed": options.seed, **vars(choice)}
    if options.pooled:
        common |= {"open_scenes": options.open_scenes, "turnover": options.turnover}
    if options.workers is None and (len(scenes) == 1 or not choice.one_per_process):
        return VecMonitor(AVPVecEnv(scenes, **common))
    return VecMonitor(AVPSubprocVecEnv(scenes, workers=options.workers, **common))


def _model(options: Train, env: Any) -> Any:
    arguments = {"seed": options.seed, **options.preset.arguments()}
    if options.start is not None:
        gentle = replace(options.preset, learning_rate=options.preset.learning_rate / _GENTLER)
        return started_ppo(options.start, env, **(arguments | gentle.arguments()))
    if options.resume is None:
        from gymnasium import spaces
        from stable_baselines3 import PPO

        policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
        model = PPO(policy, env, device="cpu", **arguments)
        return model
    with tempfile.TemporaryDirectory() as folder:
        path = _resumed_file(options.resume, folder)
        if (statistics := statistics_of(path)) is not None:
            normalised = load_statistics(statistics, env.observation_space, trusted=options.trusted)
            normalised.set_venv(env)
            env = normalised
        try:
            model = load_model(path, env=env, trusted=options.trusted)
        except ValueError as error:
            raise UsageError(f"--resume {options.resume}: does not fit these options: {error}") from None
    if model.num_timesteps >= options.steps:
        raise UsageError(f"--steps: {options.resume} has {model.num_timesteps} already; expected more")
    return model


def _imitated(options: Train, model: Any) -> Any:
    from avp_sb3.imitation import demonstrate, imitate

    shown = demonstrate(
        str(options.imitate),
        options.scenes,
        options.settings,
        episodes=options.demonstrations,
        gamma=model.gamma,
        seed=options.seed,
        choice=options.simulator,
    )
    return imitate(model, shown)


def _resumed_file(resume: str, folder: str) -> Path:
    """The model's file; MLflow's copy comes into the folder, with its statistics beside it."""
    if not resume.startswith(_MLFLOW):
        if not Path(resume).is_file():
            raise UsageError(f"--resume {resume}: no such model file")
        return Path(resume)
    import mlflow
    from mlflow.artifacts import download_artifacts
    from mlflow.exceptions import MlflowException

    from avp_habitat.tracking.stores import DEFAULT_ADDRESS, first_line, is_missing, shown

    address = mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else DEFAULT_ADDRESS
    if is_missing(address):
        raise UsageError(f"--resume {resume}: no MLflow database at {shown(address)}; set MLFLOW_TRACKING_URI")
    try:
        found = Path(download_artifacts(artifact_uri=resume, dst_path=folder, tracking_uri=address))
    except (MlflowException, OSError) as error:
        raise UsageError(f"--resume {resume}: not found at {shown(address)}: {first_line(error)}") from None
    if not found.is_file():
        raise UsageError(f"--resume {resume}: expected a model file, found a folder; add /model.zip")
    if is_normalised(found):
        # Without them `statistics_of` says what is missing.
        with suppress(MlflowException, OSError):
            beside = f"{resume.removesuffix('.zip')}_vecnormalize.pkl"
            download_artifacts(artifact_uri=beside, dst_path=folder, tracking_uri=address)
    return found


def _callbacks(options: Train, tracking: Any) -> list[Any]:
    from avp_sb3 import EvaluationCallback, MetricsCallback, RerunCallback, StopCallback

    # The stop is learned at the end, before MLflow keeps the model.
    callbacks: list[Any] = [StopCallback()] if stops_always(find_reward(str(options.reward))) else []
    # First, so that scenes that cannot be opened leave no empty run behind.
    if options.eval_scene is not None:
        best = options.out.with_stem(f"{options.out.stem}-best")
        where: dict[str, Any] = vars(options.simulator) | {"navmesh": None}  # That is the training scene's.
        callbacks.append(EvaluationCallback(options.eval_scene, every=options.eval_every, best_model=best, **where))
    callbacks += [MetricsCallback(), tracking]
    if options.recording is not None:
        callbacks.append(RerunCallback(options.recording))
    return callbacks


def main(options: Train) -> None:
    """Train, track and save."""
    check_writable(options.out)
    check_memory(options)
    print(f"opening {describe(options.scenes)} …", flush=True)

    # Late, so that --help and a mistyped option answer at once.
    import torch

    from avp_sb3 import MLflowCallback
    from avp_sb3.callbacks.best_model import save_model

    # The policy is a small network: more threads of torch only wait for each other.
    torch.set_num_threads(1)
    env = _environment(options)
    model = _model(options, env)
    if options.imitate is not None:
        print(f"imitation: {_imitated(options, model)}", flush=True)
    note_training(model, options.settings, options.scenes)
    tracking = MLflowCallback(options.experiment, run_name=options.run_name)
    callbacks = _callbacks(options, tracking)
    begun = model.num_timesteps
    try:
        with tracking:
            # With reset_num_timesteps=False, SB3 counts the steps from where the model stands.
            # Rich's bar, left open by Ctrl-C, can wait for its own thread for ever; a file has the metrics' lines.
            model.learn(
                options.steps - begun,
                callback=callbacks,
                progress_bar=sys.stdout.isatty(),
                reset_num_timesteps=options.resume is None,
            )
    finally:
        if model.num_timesteps > begun:
            save_model(model, options.out)
            for fit in (getattr(callback, "fit", None) for callback in callbacks):
                print("" if fit is None else f"stop: {fit}\n", end="")
            print(f"{options.out}: the policy after {model.num_timesteps} steps; MLflow run {tracking.run_id}")
            if model.num_timesteps < options.steps:
                again = shlex.join(["python", "-m", "avp_sb3.train", *sys.argv[1:], "--resume", str(options.out)])
                print(f"to go on:  {again}")
        env.close()


if __name__ == "__main__":
    sys.exit(command.run(main))
